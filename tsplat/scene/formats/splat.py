"""The .splat format of antimatter15/splat: 32 bytes per splat, without a header and without view-dependent colour.

Each row holds the mean and the scales (float32, linear), then as bytes the colour, the opacity and the rotation (wxyz, 128 + 128 q). Axes are
those of the .ply.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from tsplat.scene.files import replacing
from tsplat.scene.formats.checked import malformed
from tsplat.scene.formats.fields import Fields, log_scales_of, logits_of, opacities_of, rounded
from tsplat.scene.gaussians import SH_C0, Gaussians

ROW = np.dtype([("mean", "<f4", 3), ("scales", "<f4", 3), ("color", "u1", 3), ("opacity", "u1"), ("quat", "u1", 4)])


def read_splat(path: str | os.PathLike[str]) -> Gaussians:
    """Read a .splat file: float32 Gaussians of degree 0.

    Opacities of 0 and 255 get the logits +-16, scales of 0 the smallest normal float32.

    Raises:
        ValueError: the size of the file is not a multiple of 32 bytes.
        OSError: the file cannot be read.
    """
    path = Path(path)
    size = path.stat().st_size
    if size % ROW.itemsize:
        raise malformed(path, size, f"expected a multiple of {ROW.itemsize} bytes (.splat); found {size}")
    rows = np.fromfile(path, ROW)
    quats = rows["quat"].astype(np.float32) / 128 - 1
    sh0 = (rows["color"] / 255 - 0.5) / SH_C0
    return Fields(rows["mean"], quats, log_scales_of(rows["scales"]), logits_of(rows["opacity"] / 255), sh0,
                  np.empty((len(rows), 0, 3), np.float32)).gaussians()


def write_splat(path: str | os.PathLike[str], gaussians: Gaussians) -> None:
    """Write a .splat file, in the order of `gaussians`. The new file takes the place of an old one only when it is whole.

    Colours are clamped to 0..1 and rounded to 1/255, as are opacities; quaternions to 1/128. What a file cannot hold is left out with a
    warning: view-dependent colour, splats with NaN.

    Raises:
        OSError: the file cannot be written; an old one stays as it was.
    """
    fields = Fields.of(path, gaussians, 0)
    rows = np.empty(len(fields), ROW)
    rows["mean"] = fields.means
    with np.errstate(over="ignore"):
        rows["scales"] = np.exp(fields.log_scales)
    rows["color"] = rounded(255 * (SH_C0 * fields.sh0 + 0.5), 255)
    rows["opacity"] = rounded(255 * opacities_of(fields.logits), 255)
    rows["quat"] = rounded(128 * fields.quats + 128, 255)
    with replacing(path) as temporary:
        temporary.write_bytes(rows.tobytes())
