"""Shared by the tests of `tsplat.scene`: where the real data is, and small captures made on the fly."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tsplat.scene import write_image


@pytest.fixture(scope="session")
def data_root() -> Path:
    """The folder `data` of the shared test data; skips the test where it is absent."""
    repository = Path(__file__).resolve().parents[2]
    root = Path(os.environ.get("TSPLAT_DATA", repository.parent / "shared")) / "data"
    if not root.is_dir():
        pytest.skip(f"no test data in {root}: set TSPLAT_DATA to the folder that holds data/")
    return root


def ramp(width: int, height: int, phase: float = 0.0) -> Tensor:
    """A smooth colour image `[H, W, 3]` in 0..1."""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    return torch.stack([x / width, y / height, 0.5 + 0.4 * torch.sin(x / 5 + phase)], dim=-1)


@pytest.fixture(name="ramp")
def ramp_fixture() -> Callable[..., Tensor]:
    """The function `ramp(width, height, phase)`: a smooth colour image `[H, W, 3]` in 0..1."""
    return ramp


@pytest.fixture
def colmap_folder(tmp_path: Path) -> Callable[..., Path]:
    """A function that writes a tiny COLMAP capture (text) and returns its folder."""

    def make(count: int = 10, *, camera: str = "PINHOLE 24 16 20 20 12 8", photo: tuple[int, int] = (24, 16),
             model: str = "sparse/0", names: list[str] | None = None) -> Path:
        folder = tmp_path / "capture"
        (folder / model).mkdir(parents=True)
        names = names or [f"{i:03d}.png" for i in range(count)]
        lines = []
        for i, name in enumerate(names):
            path = folder / "images" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            write_image(path, ramp(*photo, phase=float(i)))
            lines.append(f"{i + 1} 1 0 0 0 {-i} 0 0 1 {name}\n1.5 2.5 -1 3.5 4.5 7\n")
        (folder / model / "cameras.txt").write_text(f"# a comment\n1 {camera}\n")
        (folder / model / "images.txt").write_text("# a comment\n" + "".join(lines))
        (folder / model / "points3D.txt").write_text("# a comment\n1 0 1 2 255 0 51 0.5 1 2 3 4\n2 3 4 5 0 255 0 0.5\n")
        return folder

    return make
