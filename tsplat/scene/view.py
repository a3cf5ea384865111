"""`View`: what the readers of COLMAP and transforms.json say of one photo."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from tsplat.scene.lens import Lens

Points: TypeAlias = tuple[NDArray[np.float32], NDArray[np.float32] | None]      # [M, 3] positions, [M, 3] colours in 0..1


@dataclass(frozen=True)
class View:
    """One posed photo.

    Args:
        name: unique in the capture; views are sorted by it.
        folder, file: the photo is `folder / file`; at 1/k of its size it may also lie in `<folder>_<k> / file`.
        viewmat: `[4, 4]` float64, world to camera, OpenCV axes.
        lens: as calibrated, which may be at another size than the file's.
        mask: a file that is black where the photo is to be left out, or None.
    """

    name: str
    folder: Path
    file: str
    viewmat: NDArray[np.float64]
    lens: Lens
    mask: Path | None = None

    def photo(self, downscale: float) -> tuple[Path, bool]:
        """The file to read, which may not exist, and whether it is already at `1 / downscale` of the full size."""
        smaller = self.folder.with_name(f"{self.folder.name}_{downscale:g}") / self.file
        if downscale != 1 and smaller.is_file():
            return smaller, True
        return self.folder / self.file, False
