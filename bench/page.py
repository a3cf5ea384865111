"""The benchmark page: one table for each JSON document in `bench/results`, newest first, with device, versions, commit, date and command; one for
all of Pulsar's applications.

python bench/page.py              # writes bench/results/README.md
python bench/page.py --check      # only says whether it is as this would write it
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).resolve().parent / "results"
Row = dict[str, Any]
Columns = dict[str, Callable[[Row], str]]

HEAD = """# What was measured

This page is made by `python bench/page.py` from the JSON files beside it, which the scripts in `bench` wrote (`--json`). What each measures, and how,
stands at the head of the script. Times on different machines do not compare, ratios in a row do: both sides ran in one process, or are scaled as
the script says.
"""


def mean(values: Iterable[float]) -> float:
    numbers = list(values)
    return sum(numbers) / len(numbers)


def spread(fits: list[Row], key: str, digits: int) -> str:
    """Mean of all seeds, and their range."""
    values = [fit[key] for fit in fits]
    text = f"{mean(values):.{digits}f}"
    return text if len(values) == 1 else f"{text} ({min(values):.{digits}f} to {max(values):.{digits}f})"


GPU: Columns = {
    "scene": lambda r: r["scene"],
    "channels": lambda r: str(r["channels"]),
    "forward ms": lambda r: f"{r['ms']['forward'][0]:.2f}",
    "fwd+bwd ms": lambda r: f"{r['ms']['both'][0]:.2f}",
    "MiB": lambda r: f"{r['peak_MiB']:.0f}",
    "gsplat's forward": lambda r: f"{r['gsplat']['forward'][0]:.2f}" if "forward" in r["gsplat"] else "none",
    "fwd+bwd": lambda r: f"{r['gsplat']['both'][0]:.2f}" if "both" in r["gsplat"] else "none",
    "times as fast": lambda r: f"{r['gsplat']['both'][0] / r['ms']['both'][0]:.2f}" if "both" in r["gsplat"] else "",
}
GROWTH: Columns = {
    "size": lambda r: f"{r['width']}x{r['height']}",
    "splats": lambda r: f"{r['n']:,}",
    "forward ms": lambda r: f"{r['forward_ms']:.0f}",
    "fwd+bwd ms": lambda r: f"{r['both_ms']:.0f}",
}
LARGE: Columns = {
    **{name: GROWTH[name] for name in ("size", "splats")},
    "fwd+bwd s": lambda r: f"{r['seconds']:.1f}",
    "GiB of the process": lambda r: f"{r['peak_bytes'] / 2**30:.2f}",
    "of them before": lambda r: f"{r['before_bytes'] / 2**30:.2f}",
}
CPU: Columns = {
    **GROWTH,
    "pairs per exp": lambda r: f"{r['pairs'] / r['forward_exps']:.3f} / {r['pairs'] / r['both_exps']:.3f}",
    "rival's, scaled": lambda r: " / ".join(f"{ms:.0f}" for ms in r["rival_ms"]),
    "ours over rival's": lambda r: f"{r['forward_ms'] / r['rival_ms'][0]:.2f} / {r['both_ms'] / r['rival_ms'][1]:.2f}",
}
SPHERES: Columns = {
    "set-up": lambda r: r["part"],
    "spheres": lambda r: f"{r['spheres']:,}",
    "size": lambda r: f"{r['width']}x{r['height']}",
    "may leave out": lambda r: f"{r['tolerance']:g}",
    "forward s": lambda r: f"{r['forward']['wall']:.3g}",
    "backward s": lambda r: f"{r['backward']['wall']:.3g}",
    "MiB": lambda r: f"{r['both_MiB']:.0f}",
}
QUALITY: Columns = {
    "capture": lambda r: r["capture"],
    "options": lambda r: ", ".join(f"{key} {value}" for key, value in r["config"].items()),
    "seeds": lambda r: str(len(r["fits"])),
    "PSNR dB": lambda r: spread(r["fits"], "psnr", 2),
    "SSIM": lambda r: spread(r["fits"], "ssim", 4),
    "splats": lambda r: f"{mean(fit['splats'] for fit in r['fits']):,.0f}",
    "wall s": lambda r: spread(r["fits"], "wall_s", 0),
    "CPU s": lambda r: spread(r["fits"], "cpu_s", 0),
    "splats/s": lambda r: f"{mean(fit['splats_per_s'] for fit in r['fits']):,.0f}" if "splats_per_s" in r["fits"][0] else "",
    "over time": lambda r: ", ".join(f"{psnr:.1f} after {seconds:.0f} s" for seconds, psnr in r["fits"][0]["curve"]),
    "where it goes": lambda r: r.get("profile", ""),
}
PEERS: Columns = {
    **{name: QUALITY[name] for name in ("capture", "options")},
    "rasteriser": lambda r: r["rasterizer"],
    "time to quality": lambda r: f"{r['to_quality']['s']:.0f} s to {r['to_quality']['psnr']:.1f} dB",
    **{name: column for name, column in QUALITY.items() if name not in ("capture", "options", "seeds", "CPU s")},
}
PHOTOS: Columns = {
    "photos": lambda r: f"{r['streamed']:,}",
    "peak MiB": lambda r: f"{r['peak_MiB']:,.0f}",
    "photos/s": lambda r: f"{r['photos_per_s']:.1f}",
    "photos per CPU s": lambda r: f"{r['photos_per_cpu_s']:.1f}",
}
DISTRIBUTED: Columns = {
    "processes": lambda r: str(r["ranks"]),
    "threads of each": lambda r: str(r["threads"]),
    "splats": lambda r: f"{r['splats']:,}",
    "cameras": lambda r: str(r["cameras"]),
    "bytes sent": lambda r: f"{r['bytes']:,}",
    "formula": lambda r: f"{r['formula']:,}",
}
OFFLOAD: Columns = {
    "splats": lambda r: f"{r['splats']:,}",
    "optimiser": lambda r: r["optimiser"],
    "taken": lambda r: f"{r['with']['taken']:,.0f}",
    "ms without": lambda r: f"{r['without']['ms']:.0f}",
    "ms with": lambda r: f"{r['with']['ms']:.0f}",
    "MiB down": lambda r: f"{r['with']['down_MiB']:.2f}",
    "MiB up": lambda r: f"{r['with']['up_MiB']:.2f}",
}

APPLICATIONS: Columns = {
    "application": lambda r: f"[{r['application']}]({r['file']})",
    "figure": lambda r: r["measure"],
    "by stage (spheres)": lambda r: "; ".join(
        f"{name} {figure:.4g}" + (f" ({r['counts'][name]:,})" if name in r.get("counts", {}) else "") for name, figure in r["figures"].items()),
    "goal": lambda r: f"{r['goal']:g}: {'met' if r['met'] else 'missed'}" if "goal" in r else "",
    "spheres": lambda r: f"{r['spheres']:,}",
    "steps": lambda r: f"{r['steps']:,}",
    "relocated": lambda r: f"{r['relocated']:,}" if "relocated" in r else "",
    "wall s": lambda r: f"{r['wall_s']:.0f}",
    "CPU s": lambda r: f"{r['cpu_s']:.0f}",
    "to know": lambda r: r.get("note", ""),
    "how": lambda r: f"`{r['command']}`, {r['machine']}, {r['threads']} threads, torch {r['torch']}, commit {r['commit']}, {r['date']}",
}


def sections(report: Row) -> list[tuple[str, Columns, list[Row]]]:
    """Title, columns and rows of what a document has."""
    if "fits" in report:
        title = f"Quality on held-out photos: {report['capture']}, {report['config'].get('primitive', 'gaussians')}, commit {report['commit']}"
        return [(title, QUALITY, [report])]
    if any("fits" in run for run in report.get("runs", [])):
        return [("Quality on a GPU, by rasteriser", PEERS, [run for run in report["runs"] if "fits" in run])]
    if "runs" in report:                                  # several commits on one machine
        return [part for run in report["runs"] for part in sections(run)]
    rows = [row for row in report.get("rows", []) if "error" not in row]
    kinds = (("gsplat", "Gaussians on a GPU, beside gsplat", GPU), ("rival_ms", "Gaussians on a CPU", CPU), ("part", "Spheres", SPHERES),
             ("ranks", "Many processes", DISTRIBUTED), ("without", "Scenes in host memory", OFFLOAD),
             ("streamed", f"Streaming photos of {report.get('width')}x{report.get('height')}, {report.get('all_MiB', 0):,.0f} MiB in all", PHOTOS))
    found = [(title, columns, rows) for key, title, columns in kinds if rows and key in rows[0]]
    found += [(title, columns, report[key] if isinstance(report[key], list) else [report[key]]) for key, title, columns in (
        ("growth", "Gaussians on a CPU, as splats and pixels grow", GROWTH), ("large", "Gaussians on a CPU, memory", LARGE)) if key in report]
    return [(title + (f", commit {report['commit']}" if "commit" in report else ""), columns, rows) for title, columns, rows in found]


def table(columns: Columns, rows: list[Row]) -> list[str]:
    lines = ["| " + " | ".join(columns) + " |", "| --- " * len(columns) + "|"]
    return lines + ["| " + " | ".join(value(row) for value in columns.values()) + " |" for row in rows]


def page(folder: Path) -> str:
    """The text, of all documents in the folder."""
    lines, applications = [HEAD], []
    for path in sorted(folder.glob("*.json"), reverse=True):
        report = json.loads(path.read_text(encoding="utf-8"))
        if "application" in report:
            applications.append(report | {"file": path.name})
            continue
        for title, columns, rows in sections(report):
            versions = [f"{key} {report[key]}" for key in ("torch", "triton", "gsplat", "threads") if report.get(key)]
            lines += [f"## {title}", "", f"{report.get('machine') or report['device']}, {report['date']}, {', '.join(versions)}"
                      + (f": `{report['command']}`" if "command" in report else "") + f" ([{path.name}]({path.name}))", "", *table(columns, rows), ""]
    if applications:
        lines += ["## Pulsar's applications", "", "Their pictures lie in `bench/pictures`. Steps: of Adam, in all. Relocated: spheres put elsewhere "
                  "between rounds of steps. CPU s: of all threads.", "", *table(APPLICATIONS, applications), ""]
    lines += ["## In words", "", "What else was measured, and what was tried: " + ", ".join(
        f"[{path.stem}]({path.name})" for path in sorted(folder.glob("2*.md"), reverse=True)) + ".", ""]
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 if the page would change")
    check, file, text = parser.parse_args().check, RESULTS / "README.md", page(RESULTS)
    if check:
        return int(not file.is_file() or file.read_text(encoding="utf-8") != text)
    file.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
