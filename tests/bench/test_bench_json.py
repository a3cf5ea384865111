"""`--json` of the scripts that measure: one document, and nothing else on stdout."""

import json
import os
import subprocess
import sys
from pathlib import Path

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
    done = subprocess.run([sys.executable, BENCH / "quality" / "fox.py", "--data", capture, "--seeds", "0", "1", "--steps", "2", "--splats", "100",
                           "--json"], env=ENVIRONMENT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["capture"] == "fox"
    assert [fit["seed"] for fit in report["fits"]] == [0, 1]
    assert [line.partition(":")[0] for line in done.stderr.splitlines()] == ["fox seed 0", "fox seed 1"]


def test_offload_moves_what_the_formula_says() -> None:
    done = subprocess.run([sys.executable, BENCH / "offload.py", "--splats", "3000", "--json"], env=ENVIRONMENT, capture_output=True, text=True,
                          timeout=120)
    assert done.returncode == 0, done.stderr
    for row in json.loads(done.stdout)["rows"]:
        assert 0 < row["with"]["taken"] < 0.1 * row["splats"]
        for way in ("down", "up"):
            assert row["with"][f"{way}_MiB"] == row["with"][f"{way}_formula_MiB"] > 0
