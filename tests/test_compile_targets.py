"""Every kernel compiles for every target without spilling registers, by the launchers that users call, without a GPU."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("triton", reason="Triton is not installed here")

ROOT = Path(__file__).resolve().parents[1]
TARGETS = ["sm_80", "sm_86", "sm_89", "sm_90", "sm_100", "sm_120", "gfx942", "gfx1100"]


@pytest.mark.parametrize("target", TARGETS)
def test_no_kernel_spills(target: str, tmp_path: Path) -> None:
    environment = {**os.environ, "TRITON_CACHE_DIR": str(tmp_path), "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "reference")])}
    environment.pop("TRITON_INTERPRET", None)
    strict = "-W", "ignore", "-W", "error:TRITON_DEFAULT_FP_FUSION"          # a kernel that does not say whether to fuse
    run = subprocess.run([sys.executable, *strict, str(ROOT / "bench" / "sass.py"), "--json", "--quick", "--targets", target],
                         capture_output=True, text=True, env=environment)
    assert run.returncode == 0, run.stderr
    kernels = json.loads(run.stdout)
    names = {k["kernel"] for k in kernels}
    assert {"blend_fwd_kernel", "blend_bwd_kernel", "feature_fwd_kernel", "feature_bwd_kernel", "count_kernel", "emit_kernel"} <= names
    assert {"outlines_kernel", "sphere_fwd_kernel", "sphere_bwd_kernel", "sphere_feature_fwd_kernel", "sphere_feature_bwd_kernel",
            "sphere_features_bwd_kernel", "nearest_kernel"} <= names
    assert any("project" in n for n in names)
    assert "adam_rows_kernel" in names
    assert "may_see_kernel" in names
    assert any("harmonics" in n for n in names)
    assert {(k["kernel"], k["label"]): k["spills"] for k in kernels if k["spills"] != 0} == {}
    if target == "sm_90":                               # instructions per pair of pixel and splat, of RGB in float32
        goals = {"blend_fwd_kernel": 13.5, "blend_bwd_kernel": 35}
        counts = {k["kernel"]: k["per_pair"] for k in kernels if k["kernel"] in goals and k["label"] == "3 channels"}
        assert counts.keys() == goals.keys()
        assert {name: count for name, count in counts.items() if count > goals[name]} == {}
    for name in ("blend_bwd_kernel", "sphere_bwd_kernel") if target == "sm_90" else ():
        atomics = {k["label"]: sum(loop.get("atomic", 0) for loop in k["loops"]) for k in kernels if k["kernel"] == name}
        assert atomics["3 channels"] > 0
        assert atomics["3 channels, deterministic"] == 0
