"""What is to run on a GPU at the first call: `bench/gpu.py` with stand-ins for what asks a GPU for times, and the drop-in for the peer, and
`bench/spheres.py` on a CPU, both with small scenes."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

BENCH = Path(__file__).resolve().parents[2] / "bench"
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(map(os.path.abspath, [BENCH, *sys.path])), "OMP_NUM_THREADS": "1"}
GPU = """
import sys, torch, gpu, output
from scenes import random_scene
import tsplat.compat.gsplat

def milliseconds(run, times=20):
    run()
    return 2.0, 0.1

def scene(channels, sh_degree=None):
    s = random_scene(300, 48, 32)
    size = (300, channels) if sh_degree is None else (300, (sh_degree + 1) ** 2, channels)
    return s._replace(colors=torch.rand(size), background=torch.rand(channels), sh_degree=sh_degree)

def capture(run):
    run()
    return 1.0

torch.cuda.is_available = lambda: True
gpu.DEVICE, gpu.milliseconds, gpu.graph_time = "cpu", milliseconds, capture
gpu.peak_MiB = lambda run: 3.0 * bool(run())
gpu.environment = lambda _: output.environment("cpu") | {"triton": "none", "machine": "NVIDIA Made Up"}
gpu.copy_bandwidth = lambda: 3000.0
gpu.fixed_scenes = lambda *_: [("few", 3, lambda: scene(3)), ("many", 128, lambda: scene(128)), ("trained", 3, lambda: scene(3, 2))]
if "gsplat" in sys.argv:
    sys.argv.remove("gsplat")
    sys.modules["gsplat"] = tsplat.compat.gsplat
sys.exit(gpu.main())
"""
SPHERES = """
import spheres
spheres.TABLE = [spheres.Setup("Table 2", 15_099, 0.06, 24, 24), spheres.Setup("Table 2", 40, 0.2, 24, 24, 0.0)]
spheres.FIGURE = [spheres.of_figure(50, 24, 24)]
if __name__ == "__main__":
    spheres.main()
"""


def run(script: str, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", script, *map(str, arguments)], env=ENVIRONMENT, capture_output=True, text=True, timeout=120)


def test_gpu(tmp_path: Path) -> None:
    done = run(GPU, "gsplat", "--parts", "scenes", "--out", tmp_path, "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert [(row["scene"], row["gsplat"]["agrees"]) for row in report["rows"]] == [("few", True), ("many", True), ("trained", True)]
    assert [json.loads(path.read_text()) for path in tmp_path.glob("*.json")] == [report]
    table, = (path.read_text() for path in tmp_path.glob("*-gpu-made-up.md"))
    assert "1.00 (1: met)" in table
    assert "1.00 (8: missed)" in table
    assert "1.00 (0.5: missed)" in table
    assert {*report["rows"][2]["ms"]} - {*report["rows"][0]["ms"]} == {"harmonics", "harmonics_backward"}


def test_gpu_in_parts(tmp_path: Path) -> None:
    """A second call takes what the first left, and a peer that is not there is said to be missing."""
    assert run(GPU, "--parts", "scenes", "--scenes", "few", "--out", tmp_path).returncode == 0
    done = run(GPU, "--parts", "scenes", "--minutes", "5", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    assert "few, 3 channels: measured before" in done.stdout
    report, = (json.loads(path.read_text()) for path in tmp_path.glob("*.json"))
    assert [(row["scene"], row["gsplat"]) for row in report["rows"]] == [
        (name, {"missing": "gsplat cannot be imported"}) for name in ("few", "many", "trained")]
    done = run(GPU, "--parts", "tests", "--pytest", "--collect-only tests/test_no_such_file.py", "--out", tmp_path)
    assert done.returncode == 1
    report, = (json.loads(path.read_text()) for path in tmp_path.glob("*.json"))
    assert len(report["rows"]) == 3
    assert "no such file" in done.stdout or "not found" in done.stdout


def test_spheres(tmp_path: Path) -> None:
    done = run(SPHERES, "--device", "cpu", "--no-figure", "--times", "2", "--threads", "1", "--out", tmp_path, "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert [row["spheres"] for row in report["rows"]] == [15_099, 40, 50]
    for row in report["rows"]:
        assert min(row["forward"]["wall"], row["both"]["wall"]) > 0
    assert [json.loads(path.read_text()) for path in tmp_path.glob("*-spheres-cpu.json")] == [report]
    table, = (path.read_text() for path in tmp_path.glob("*-spheres-cpu.md"))
    assert re.search(r"\| forward 1300: (met|missed), backward 2600: (met|missed) \|", table)


@pytest.mark.parametrize("script", ["gpu.py", "sweep.py"])
def test_without_a_gpu(script: str) -> None:
    done = subprocess.run([sys.executable, BENCH / script], env={**ENVIRONMENT, "CUDA_VISIBLE_DEVICES": ""}, capture_output=True, text=True)
    assert done.returncode == 2
    assert "no GPU" in done.stderr
