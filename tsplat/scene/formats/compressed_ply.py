"""PlayCanvas's compressed .ply: chunks of 256 splats, whose means, scales and colours are coded between the bounds of their chunk.

A row of the element `vertex` is four 32-bit words; `chunk` holds the bounds, and `sh` the coefficients beyond degree 0 as bytes, channel by channel.
Axes are those of the 3DGS .ply.
"""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsplat.scene.files import replacing
from tsplat.scene.formats.checked import malformed
from tsplat.scene.formats.fields import Fields, Floats, from_smallest_three, logits_of, opacities_of, rounded, smallest_three
from tsplat.scene.gaussians import MAX_SH_DEGREE, SH_C0, Gaussians
from tsplat.scene.ply_table import binary_rows, read_header

CHUNK = 256                                          # splats
BOUNDS = tuple(f"{end}_{name}" for names in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b")) for end in ("min", "max")
               for name in names)
WITHOUT_COLORS = 12                                  # bounds in files of the first version, whose colours are between 0 and 1
WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
POINT_BITS, ROTATION_BITS, COLOR_BITS = (11, 10, 11), (10, 10, 10), (8, 8, 8, 8)
SH_RANGE = 8.0                                       # coefficients are coded between -4 and 4
MAX_WRITTEN_DEGREE = 3                               # what other programs read
MAX_LOG_SCALE = 20.0


def is_compressed_ply(path: Path) -> bool:
    """Whether a .ply is of this kind, by its header; ValueError if it is no .ply."""
    elements = read_header(path).elements
    return "chunk" in elements or any(name == WORDS[0] for name, _ in elements["vertex"][1])


def read_compressed_ply(path: str | os.PathLike[str]) -> Gaussians:
    """Read a PlayCanvas compressed .ply, with or without spherical harmonics.

    Returns:
        float32 Gaussians. Opacities of 0 and 255 get the logits +-16.

    Raises:
        ValueError: naming the file, where in it, and what is wrong.
        OSError: the file cannot be read.
    """
    path = Path(path)
    header = read_header(path)
    count, words = header.elements["vertex"]
    chunks, bounds = header.elements.get("chunk", (0, []))
    sh_count, coefficients = header.elements.get("sh", (count, []))
    names = [name for name, _ in bounds]
    rest = [(f"f_rest_{i}", "<u1") for i in range(len(coefficients))]
    degrees = {3 * ((degree + 1) ** 2 - 1): degree for degree in range(MAX_SH_DEGREE + 1)}
    reason = None
    if header.format != "binary_little_endian":
        reason = f"a binary_little_endian .ply; got {header.format or 'no format'}"
    elif dict(words) != dict.fromkeys(WORDS, "<u4"):
        reason = f"the columns {', '.join(WORDS)} of type uint; got {', '.join(name for name, _ in words)}"
    elif set(names) not in ({*BOUNDS}, {*BOUNDS[:WITHOUT_COLORS]}) or any(kind != "<f4" for _, kind in bounds):
        reason = f"the bounds {', '.join(BOUNDS)} of type float in the element `chunk`; got {', '.join(names) or 'none'}"
    elif chunks != -(-count // CHUNK):
        reason = f"{-(-count // CHUNK)} chunks for {count} splats; got {chunks}"
    elif sh_count != count or len(rest) not in degrees or coefficients != rest:
        reason = f"{count} rows of f_rest_0, f_rest_1, ... of type uchar in the element `sh`; got {sh_count} of {len(coefficients)} columns"
    if reason:
        raise malformed(path, 0, f"expected {reason}")

    limits = _columns(binary_rows(path, header, "chunk"), tuple(name for name in BOUNDS if name in names))
    rows = binary_rows(path, header, "vertex")
    position, rotation, scale, color = (_unpacked(rows[name], bits) for name, bits in zip(
        WORDS, (POINT_BITS, ROTATION_BITS, POINT_BITS, COLOR_BITS), strict=True))
    with np.errstate(invalid="ignore", over="ignore"):                       # bounds may be infinite
        means, log_scales = _between(limits[:, 0:6], position), _between(limits[:, 6:12], scale)
        colors = _between(limits[:, 12:], color[:, :3]) if limits.shape[1] > WITHOUT_COLORS else color[:, :3]
        sh0 = ((colors - 0.5) / SH_C0).astype(np.float32)
    quats = from_smallest_three((rows["packed_rotation"] >> 30).astype(np.int64), (rotation - 0.5) * math.sqrt(2))
    codes = binary_rows(path, header, "sh").view("u1").reshape(count, 3, len(rest) // 3) if rest else np.empty((count, 3, 0), np.uint8)
    table = (np.arange(256, dtype=np.float32) + 0.5) / 256
    table[[0, 255]] = 0, 1
    return Fields(means, quats, log_scales, logits_of(color[:, 3]), sh0, SH_RANGE * (table[codes] - 0.5).transpose(0, 2, 1)).gaussians()


def write_compressed_ply(path: str | os.PathLike[str], gaussians: Gaussians) -> None:
    """Write a PlayCanvas compressed .ply, in the order of `nearby_order`. The new file takes the place of an old one only when it is whole.

    Steps: means and log scales 1/2047 (the second 1/1023) and sh0 1/255 of their range in the chunk, opacities 1/255, rotations 1/723, other
    coefficients 1/32 within +-4. What a file cannot hold is left out with a warning: degree 4, splats with NaN. Scales are clamped to e^+-20.

    Raises:
        OSError: the file cannot be written; an old one stays as it was.
    """
    fields = Fields.of(path, gaussians, MAX_WRITTEN_DEGREE)
    count = len(fields)
    order = nearby_order(fields.means)
    starts = np.arange(0, count, CHUNK)
    limits, codes = [], []
    for values in (fields.means, fields.log_scales.clip(-MAX_LOG_SCALE, MAX_LOG_SCALE), SH_C0 * fields.sh0 + 0.5):
        values = values[order]
        low, high = (bound.reduceat(values, starts) if count else values for bound in (np.minimum, np.maximum))
        limits += [low, high]
        low, high = (np.repeat(bound, CHUNK, axis=0)[:count].astype(np.float64) for bound in (low, high))
        codes.append((values - low) / np.where(high > low, high - low, 1))
    largest, small = smallest_three(fields.quats[order])
    rotation = _packed(small / math.sqrt(2) + 0.5, ROTATION_BITS) | largest.astype(np.int64) << 30
    color = np.concatenate([codes[2], opacities_of(fields.logits[order])[:, None]], axis=1)
    rows = np.stack([_packed(codes[0], POINT_BITS), rotation, _packed(codes[1], POINT_BITS), _packed(color, COLOR_BITS)], axis=1)
    rest = fields.sh_rest[order].transpose(0, 2, 1).reshape(count, 3 * fields.sh_rest.shape[1])
    shades = np.floor(256 * (rest / SH_RANGE + 0.5)).clip(0, 255).astype("u1")

    elements = [("chunk", len(starts), "float", BOUNDS), ("vertex", count, "uint", WORDS)]
    elements += [("sh", count, "uchar", tuple(f"f_rest_{i}" for i in range(rest.shape[1])))] if rest.shape[1] else []
    lines = ["ply", "format binary_little_endian 1.0"]
    for name, size, kind, properties in elements:
        lines += [f"element {name} {size}", *(f"property {kind} {item}" for item in properties)]
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join([*lines, "end_header\n"]).encode("ascii"))
        file.write(np.concatenate(limits, axis=1).astype("<f4").tobytes())
        file.write(rows.astype("<u4").tobytes())
        file.write(shades.tobytes())


def nearby_order(means: Floats) -> NDArray[np.int64]:
    """The order `[N]` of a Morton curve through the means: neighbours in it are near each other, so that chunks have narrow bounds."""
    if not len(means):
        return np.empty(0, np.int64)
    low, high = means.min(0).astype(np.float64), means.max(0).astype(np.float64)
    cells = ((means - low) / np.where(high > low, high - low, 1) * ((1 << 21) - 1)).astype(np.uint64)
    curve = np.zeros(len(means), np.uint64)
    for axis in range(3):
        for bit in range(21):
            curve |= (cells[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return curve.argsort(kind="stable")


def _columns(rows: NDArray[Any], names: tuple[str, ...]) -> Floats:
    return np.stack([rows[name] for name in names], axis=1).astype(np.float32)


def _between(limits: Floats, part: Floats) -> Floats:
    """From parts `[N, 3]` of the way from the lower bounds `limits[:, :3]` of each chunk to the upper ones."""
    low, high = (np.repeat(bound, CHUNK, axis=0)[:len(part)] for bound in (limits[:, :3], limits[:, 3:]))
    return (low * (1 - part) + high * part).astype(np.float32)


def _packed(values: Floats, bits: tuple[int, ...]) -> NDArray[np.int64]:
    """Values `[N, n]` in 0..1 as whole numbers of so many bits, the first in the highest bits."""
    word: NDArray[np.int64] = np.zeros(len(values), np.int64)
    for i, width in enumerate(bits):
        largest = (1 << width) - 1
        word = word << width | rounded(values[:, i] * largest, largest)
    return word


def _unpacked(word: NDArray[np.uint32], bits: tuple[int, ...]) -> Floats:
    """The inverse of `_packed`: `[N, n]`."""
    shifts = np.cumsum((0, *bits[:0:-1]))[::-1]
    largest = (1 << np.array(bits)) - 1
    values: Floats = (word[:, None] >> shifts & largest) / largest
    return values
