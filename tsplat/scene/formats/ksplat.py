"""The .ksplat format of mkkellogg/GaussianSplats3D, version 0.1: sections of rows, in three levels of compression.

A header of 4096 bytes and one of 1024 bytes per section are followed by the sections: the sizes of buckets that are not full, the centres of all
buckets, the rows. Level 0 has float32; 1 and 2 have float16 and means of 16 bits around the centres of buckets, 2 has coefficients of 8 bits. Axes
are those of the .ply.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsplat.scene.formats.checked import Reader, malformed
from tsplat.scene.formats.fields import Fields, Floats, log_scales_of, logits_of
from tsplat.scene.gaussians import SH_C0, Gaussians

HEADER = struct.Struct("<BB2xI8xIH14xff4052x")                   # version, sections, splats, level, bounds of coefficients of level 2
SECTION = struct.Struct("<IIIIfH2xI4xIIH982x")                   # splats, rows, of a full bucket, buckets, ...
SH_RANGE = 1.5                                                   # bounds of coefficients where the header has none
MEAN_RANGE = 32767                                               # of the codes of means where the section has none
MAX_DEGREE = 2


def read_ksplat(path: str | os.PathLike[str]) -> Gaussians:
    """Read a .ksplat file.

    Returns:
        float32 Gaussians of degree 0 to 2. Opacities of 0 and 255 get the logits +-16, scales of 0 the smallest normal float32.

    Raises:
        ValueError: naming the file, where in it, and what is wrong.
        OSError: the file cannot be read.
    """
    path = Path(path)
    reader = Reader(path, path.read_bytes())
    major, minor, sections, count, level, low, high = HEADER.unpack(reader.take(HEADER.size, "the header"))
    if (major, minor) != (0, 1):
        raise malformed(path, 0, f"expected .ksplat version 0.1; got {major}.{minor}")
    if level > 2:
        raise malformed(path, 20, f"expected compression level 0 to 2; got {level}")
    headers = [(reader.offset, SECTION.unpack(reader.take(SECTION.size, "the header of a section"))) for _ in range(sections)]
    bounds = np.array([low or -SH_RANGE, high or SH_RANGE], np.float32)
    parts = [_section(reader, offset, header, level, bounds) for offset, header in headers]
    reader.end()
    found = sum(len(part) for part in parts)
    if found != count or not parts:
        raise malformed(path, 16, f"expected {count} splats, as the header says; found {found} in {len(parts)} sections")
    return Fields.joined(parts).gaussians()


def _section(reader: Reader, offset: int, header: tuple[Any, ...], level: int, bounds: Floats) -> Fields:
    count, capacity, size, buckets, block, bucket_bytes, mean_range, full, partial, degree = header
    if degree > MAX_DEGREE:
        raise malformed(reader.path, offset + 40, f"expected spherical harmonics of degree 0 to {MAX_DEGREE}; got {degree}")
    if count > capacity or (buckets and bucket_bytes != 12) or full + partial != buckets:
        raise malformed(reader.path, offset, f"expected at most {capacity} splats and {full} + {partial} buckets of 12 bytes; got {count} and "
                        f"{buckets} of {bucket_bytes}")
    last_sizes = reader.array("<u4", (partial,), "sizes of buckets")
    centres = reader.array("<f4", (buckets, 3), "centres of buckets")
    rows = reader.array(_row_type(level, degree), (capacity,), "splats")[:count]
    means: Floats = rows["mean"]
    if level:
        sizes = np.concatenate([np.full(full, size, np.int64), last_sizes])
        bucket = np.searchsorted(np.cumsum(sizes), np.arange(count), side="right")
        if count and bucket[-1] >= buckets:
            raise malformed(reader.path, offset, f"expected buckets for {count} splats; got them for {sizes.sum()}")
        middle = mean_range or MEAN_RANGE
        with np.errstate(over="ignore", invalid="ignore"):       # blocks and centres may be absurd
            means = (means.astype(np.float64) - middle) * (block / 2 / middle) + centres[bucket]
    rest: NDArray[Any] = rows["harmonics"]
    if level == 2:
        with np.errstate(over="ignore", invalid="ignore"):
            rest = bounds[0] + rest / np.float32(255) * (bounds[1] - bounds[0])
    bands = [rest[:, 3 * (d * d - 1):3 * ((d + 1) ** 2 - 1)].reshape(count, 3, 2 * d + 1).transpose(0, 2, 1) for d in range(1, degree + 1)]
    return Fields(means, rows["quat"], log_scales_of(rows["scales"].astype(np.float32)), logits_of(rows["color"][:, 3] / 255),
                  (rows["color"][:, :3] / 255 - 0.5) / SH_C0, np.concatenate(bands, axis=1) if bands else np.empty((count, 0, 3), np.float32))


def _row_type(level: int, degree: int) -> np.dtype[Any]:
    """Coefficients are channel by channel within a degree."""
    wide, narrow = ("<f4", "<f4") if level == 0 else ("<f2", "<u2")
    rest = ("<f4", "<f2", "u1")[level]
    return np.dtype([("mean", narrow, 3), ("scales", wide, 3), ("quat", wide, 4), ("color", "u1", 4),
                     ("harmonics", rest, (3 * ((degree + 1) ** 2 - 1),))])
