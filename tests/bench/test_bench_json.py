"""`--json` of the scripts that measure: one document, and nothing else on stdout."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tsplat.scene import write_synthetic_capture

BENCH = Path(__file__).resolve().parents[2] / "bench"
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(map(os.path.abspath, [BENCH, *sys.path])), "OMP_NUM_THREADS": "1"}
SPEED = """
import contextlib, io, json, sys, torch
torch.cuda.is_available = lambda: True
def measured(*arguments, **options):
    print("| a table |")
    return {"rows": [1.5]}
for name, options in (("cpu", ["--quick"]), ("spheres", ["--no-figure", "--device", "cpu"]), ("gpu", []), ("offload", []),
                      ("distributed", [])):
    module = __import__(name)
    module.measure_all = measured                       # the measurements themselves take minutes, and a GPU
    out, sys.argv = io.StringIO(), [name, "--json", *options]
    with contextlib.redirect_stdout(out):
        assert not module.main()
    assert json.loads(out.getvalue()) == {"rows": [1.5]}, out.getvalue()
"""


def test_speed() -> None:
    done = subprocess.run([sys.executable, "-c", SPEED], env=ENVIRONMENT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stderr == "| a table |\n" * 5


def test_quality(tmp_path: Path) -> None:
    capture = write_synthetic_capture(tmp_path, views=8, size=(32, 24))
    done = subprocess.run([sys.executable, BENCH / "quality" / "fox.py", "--data", capture, "--seeds", "0", "1", "--steps", "6", "--splats", "100",
                           "--curve", "0.5", "--profile", "--json"], env=ENVIRONMENT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["capture"] == "fox"
    assert [fit["seed"] for fit in report["fits"]] == [0, 1]
    assert [len(fit["curve"]) for fit in report["fits"]] == [1, 1]
    assert all(fit["splats_per_s"] > 0 for fit in report["fits"])
    assert re.search(r"^of [\d.]+ ms a step: .*blending, backward \d+ %", report["profile"])
    assert re.search(r"binning \d+ %", report["profile"])
    lines = [line for line in done.stderr.splitlines() if line.startswith(("fox", "  of"))]           # torch has notes of its own
    assert [line.partition(":")[0] for line in lines] == ["fox seed 0", "fox seed 1", f"  {report['profile'].partition(':')[0]}"]


GPU = """
import runpy, sys, torch
import gpu, output
sys.argv = ["gpu", "--json", "--captures", "fox", "chair", "--steps", "7000"]
assert torch.cuda.is_available() or gpu.main() == 2
torch.cuda.is_available = lambda: True
output.environment = gpu.environment = lambda device: dict(device=device)
def fit(command, **_):
    value = lambda option: command[command.index(option) + 1]
    assert value("--device") == "cuda" and value("--downscale") == "1", command
    name = value("--rasterizer")
    if command[1].endswith("chair.py"):
        return gpu.subprocess.CompletedProcess(command, 1, "", "Traceback\\nRuntimeError: no more memory\\n")
    scores = [(10.0, 20.0), (30.0, 28.0)] if name == "tsplat" else [(20.0, 20.0), (60.0, 30.0)]
    one = dict(psnr=31.0, ssim=0.9, splats=5, steps=int(value("--steps")), wall_s=99.0, steps_s=90.0, cpu_s=1.0, splats_per_s=2e6, seed=0,
               curve=scores)
    report = dict(rasterizer=name, capture="fox", config=dict(), fits=[one], profile="of 3 ms on the GPU a step: blending 50 %")
    return gpu.subprocess.CompletedProcess(command, 0, gpu.json.dumps(report), "")
gpu.subprocess.run = fit
assert not gpu.main()
sys.modules["gsplat"] = None
sys.argv = ["fox.py", "--rasterizer", "gsplat"]
runpy.run_path(str(gpu.HERE / "fox.py"), run_name="__main__")
"""


def test_all_fits_on_a_gpu() -> None:
    """What the command makes of the documents of scripts, with made-up fits, as none can be made here; and what is said without GPU or gsplat."""
    environment = {**ENVIRONMENT, "PYTHONPATH": os.pathsep.join([str(BENCH / "quality"), ENVIRONMENT["PYTHONPATH"]])}
    done = subprocess.run([sys.executable, "-c", GPU], env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2, done.stderr
    assert torch.cuda.is_available() or "gpu.py: no GPU: torch.cuda.is_available() is False" in done.stderr
    assert done.stderr.splitlines()[-1].startswith("fox.py: error: --rasterizer: gsplat cannot be imported")
    ours, theirs, *failed = json.loads(done.stdout)["runs"]
    assert ours["to_quality"] == {"psnr": 30.5, "s": 30 + 60 * 2.5 / 3}
    assert theirs["to_quality"] == {"psnr": 30.5, "s": 60 + 30 * 0.5}
    assert [run["error"] for run in failed] == ["RuntimeError: no more memory"] * 2
    assert "| fox | 7,000 | gsplat | 31.00 | 0.9000 | 5 | 99 | 2e+06 | 75 (30.5 dB) |" in done.stderr


def test_streamed_photos(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(BENCH)
    import photos

    report = photos.measure_all([2, 6], (64, 48))
    assert [row["streamed"] for row in report["rows"]] == [2, 6]
    assert report["all_MiB"] == 6 * 64 * 48 * 3 / 2**20
    assert report["before_MiB"] > 0
    assert all(row["photos_per_cpu_s"] > 0 for row in report["rows"])


def test_offload_moves_what_the_formula_says() -> None:
    done = subprocess.run([sys.executable, BENCH / "offload.py", "--splats", "3000", "--json"], env=ENVIRONMENT, capture_output=True, text=True,
                          timeout=120)
    assert done.returncode == 0, done.stderr
    for row in json.loads(done.stdout)["rows"]:
        assert 0 < row["with"]["taken"] < 0.1 * row["splats"]
        for way in ("down", "up"):
            assert row["with"][f"{way}_MiB"] == row["with"][f"{way}_formula_MiB"] > 0
