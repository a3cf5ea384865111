"""The benchmark page is what its script makes of the results that are committed."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

BENCH = Path(__file__).resolve().parents[2] / "bench"


def test_the_page_is_up_to_date() -> None:
    assert subprocess.run([sys.executable, BENCH / "page.py", "--check"]).returncode == 0, "run python bench/page.py"


def test_the_page_has_every_document() -> None:
    text = (BENCH / "results" / "README.md").read_text(encoding="utf-8")
    for path in [*(BENCH / "results").glob("*.json"), *(BENCH / "results").glob("2*.md")]:
        assert f"]({path.name})" in text, path.name


def test_fits_on_a_gpu_are_one_table(monkeypatch: pytest.MonkeyPatch) -> None:
    """As `bench/quality/gpu.py` has them, without those that failed."""
    monkeypatch.syspath_prepend(BENCH)
    import page

    fit = {"psnr": 31.0, "ssim": 0.9, "splats": 5, "wall_s": 90.0, "splats_per_s": 2345678.0, "curve": [[3.0, 20.0]]}
    run = {"rasterizer": "gsplat", "capture": "fox", "config": {"steps": 7000}, "fits": [fit], "profile": "of 3 ms",
           "to_quality": {"s": 30, "psnr": 30.5}}
    ((_, columns, rows),) = page.sections({"runs": [run, {"error": "no memory"}]})
    assert page.table(columns, rows)[2:] == [
        "| fox | steps 7000 | gsplat | 30 s to 30.5 dB | 31.00 | 0.9000 | 5 | 90 | 2,345,678 | 20.0 after 3 s | of 3 ms |"]


def test_applications_are_one_table(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Each document is a row, with the file that it is from; keys that few have may be missing."""
    monkeypatch.syspath_prepend(BENCH)
    import page

    one = {"application": "head", "measure": "PSNR", "figures": {"volume": 20.123, "pruned": 21.5}, "counts": {"volume": 4000}, "spheres": 900,
           "steps": 1200, "machine": "a CPU", "wall_s": 61.2, "cpu_s": 99.6, "threads": 2, "torch": "2.9", "commit": "abc",
           "date": "2026-01-02", "command": "python head.py"}
    other = one | {"application": "silhouettes", "figures": {"end": 0.91}, "goal": 0.9, "met": True, "relocated": 1234, "note": "L1 alone"}
    for report in (one, other):
        (tmp_path / f"{report['application']}.json").write_text(json.dumps(report))
    text = page.page(tmp_path)
    assert text.count("## Pulsar's applications") == 1
    how = "`python head.py`, a CPU, 2 threads, torch 2.9, commit abc, 2026-01-02"
    assert f"| [head](head.json) | PSNR | volume 20.12 (4,000); pruned 21.5 |  | 900 | 1,200 |  | 61 | 100 |  | {how} |" in text
    assert f"| [silhouettes](silhouettes.json) | PSNR | end 0.91 | 0.9: met | 900 | 1,200 | 1,234 | 61 | 100 | L1 alone | {how} |" in text
