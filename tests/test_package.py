"""What importing tsplat needs and does, in processes of their own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

WITHOUT = """
import sys
class Without:                                  # nothing is found under these names, as where they are not installed
    def __init__(self, finder): self.finder = finder
    def find_spec(self, name, path=None, target=None):
        return None if name.partition(".")[0] in {names} else self.finder.find_spec(name, path, target)
sys.meta_path[:] = [Without(finder) for finder in sys.meta_path]
"""
RENDER = """
import torch, tsplat
cam = tsplat.Camera.look_at([0, 0, -3], [0, 0, 0], width=12, height=8)
means = torch.zeros(2, 3, requires_grad=True)
quats, scales = torch.tensor([[1.0, 0, 0, 0]] * 2), torch.full((2, 3), 0.3)
image = tsplat.rasterize(means, quats, scales, torch.full((2,), 0.8), torch.ones(2, 3), cam).image
image.sum().backward()
assert image[4, 6, 0] > 0.9 and means.grad.isfinite().all()
"""


def run(code: str) -> str:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "reference")])}
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", code], env=environment, capture_output=True, text=True,
                          timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_importing_is_light() -> None:
    """No photo library, no compiler, no progress bar: they come when they are used."""
    heavy = {"kornia", "kornia_rs", "triton", "tqdm", "PIL", "torch._dynamo.convert_frame", "torch._inductor.compile_fx"}
    out = run("import torch, sys; before = set(sys.modules); import tsplat\n"
              f"print(sorted({heavy} & (set(sys.modules) - before)))")
    assert out.strip() == "[]"


def test_rendering_needs_torch_and_numpy_only() -> None:
    """In particular no Triton, which macOS and Windows do not have."""
    run(WITHOUT.format(names={"triton", "kornia", "kornia_rs", "tqdm", "PIL", "scipy"}) + RENDER)


def test_importing_works_where_processes_do_not_fork() -> None:
    """As on Windows, where `os.register_at_fork` does not exist."""
    run("import os, torch\nfor name in ('fork', 'register_at_fork'): delattr(os, name)\nimport tsplat")


def test_the_reference_imports_torch_and_nothing_of_tsplat() -> None:
    out = run("import torch, sys; before = set(sys.modules); import tsplat_reference\n"
              "new = {m.partition('.')[0] for m in set(sys.modules) - before} - set(sys.stdlib_module_names)\n"
              "print(sorted(new))")
    assert out.strip() in ("['tsplat_reference']", "['torch', 'tsplat_reference']")


@pytest.mark.parametrize("package", ["tsplat", "tsplat_reference"])
def test_types_are_declared(package: str) -> None:
    assert (Path(__import__(package).__file__).parent / "py.typed").is_file()


def test_the_public_names_are_there() -> None:
    import tsplat
    for name in ("rasterize", "Camera", "Rendering", "Meta", "Gaussians", "load_capture", "__version__"):
        assert hasattr(tsplat, name), name
