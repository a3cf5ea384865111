"""The 3DGS .ply format: raw parameters as float32 columns, one row per Gaussian, `f_rest` channel by channel."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from tsplat.scene.gaussians import MAX_SH_DEGREE, Gaussians
from tsplat.scene.ply_table import binary_rows, columns, read_header, row_type, write_columns

MEANS, NORMALS, DC = ("x", "y", "z"), ("nx", "ny", "nz"), ("f_dc_0", "f_dc_1", "f_dc_2")
SCALES, QUATS = ("scale_0", "scale_1", "scale_2"), ("rot_0", "rot_1", "rot_2", "rot_3")
MAX_LOGIT = 16.0                # stands for an infinite logit, which quantised formats give for opacity 0 and 1


def read_ply(path: str | os.PathLike[str]) -> Gaussians:
    """Read a 3DGS .ply: little endian, columns in any order, of any scalar type; others than needed are passed over.

    Returns:
        float32 Gaussians of the degree that the number of `f_rest` columns (0, 9, 24, 45 or 72) gives. Infinite opacity
        logits become +-16.

    Raises:
        ValueError: naming the file and what is wrong: not a .ply, ascii, big endian or PlayCanvas's compressed variant,
            columns missing, fewer bytes than the header announces.
        OSError: the file cannot be read.
    """
    path = Path(path)
    header = read_header(path)
    _, properties = header.elements["vertex"]
    names = [name for name, _ in properties]
    if "chunk" in header.elements or "packed_position" in names:
        raise ValueError(f"{path}: this is a PlayCanvas compressed .ply; expected a plain 3DGS .ply (Gaussians.load reads both)")
    if header.format != "binary_little_endian":
        raise ValueError(f"{path}: expected a binary_little_endian .ply of Gaussians; got {header.format}")
    missing = [name for name in (*MEANS, *DC, "opacity", *SCALES, *QUATS) if name not in names]
    if missing:
        raise ValueError(f"{path}: a 3DGS .ply needs the columns {', '.join(missing)}; this one has {', '.join(names)}")
    rest = sum(name.startswith("f_rest_") for name in names)
    rest_names = tuple(f"f_rest_{i}" for i in range(rest))
    degrees = {3 * ((degree + 1) ** 2 - 1): degree for degree in range(MAX_SH_DEGREE + 1)}
    if rest not in degrees or not set(rest_names) <= set(names):
        raise ValueError(f"{path}: expected {', '.join(map(str, degrees))} columns f_rest_0, f_rest_1, ...; got {rest}")

    rows = binary_rows(path, header)
    logits = columns(rows, ("opacity",))[:, 0]
    logits = torch.where(logits.isinf(), logits.sign() * MAX_LOGIT, logits)
    sh_rest = columns(rows, rest_names).view(len(rows), 3, rest // 3).transpose(1, 2)      # channel-major in the file
    return Gaussians(columns(rows, MEANS), columns(rows, QUATS), columns(rows, SCALES), logits,
                     columns(rows, DC)[:, None], sh_rest)


def write_ply(path: str | os.PathLike[str], gaussians: Gaussians) -> None:
    """Write a 3DGS .ply (float32, little endian, zero normals, as the Inria code orders its columns).

    The new file takes the place of an old one only when it is whole.

    Raises:
        OSError: the file cannot be written; an old one stays as it was.
    """
    rest = gaussians.sh_rest.transpose(1, 2).flatten(1)                                     # [N, 3 (K - 1)] channel-major
    names = (*MEANS, *NORMALS, *DC, *(f"f_rest_{i}" for i in range(rest.shape[1])), "opacity", *SCALES, *QUATS)
    rows = torch.cat([gaussians.means, torch.zeros_like(gaussians.means), gaussians.sh0.flatten(1), rest,
                      gaussians.opacity_logits[:, None], gaussians.log_scales, gaussians.quats], dim=1)
    write_columns(path, names, rows)


def read_point_ply(path: str | os.PathLike[str]) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """Read the points of an ascii or little-endian .ply: `[M, 3]` positions and `[M, 3]` colours in 0..1 (None without).

    Raises:
        ValueError: as `read_ply`.
    """
    path = Path(path)
    header = read_header(path)
    count, properties = header.elements["vertex"]
    names = [name for name, _ in properties]
    colors = ("red", "green", "blue")
    if not set(MEANS) <= set(names):
        raise ValueError(f"{path}: a point cloud needs the columns x, y, z; this one has {', '.join(names)}")
    if header.format == "ascii" and next(iter(header.elements)) == "vertex":
        with path.open("rb") as file:
            file.seek(header.size)
            table = np.loadtxt(file, dtype=np.float64, max_rows=count, ndmin=2) if count else np.empty((0, len(names)))
        if table.shape != (count, len(names)):
            raise ValueError(f"{path}: expected {count} rows of {len(names)} numbers; got {list(table.shape)}")
        rows = np.empty(count, row_type(path, "vertex", properties))
        for i, column in enumerate(names):
            rows[column] = table[:, i]
    elif header.format == "binary_little_endian":
        rows = binary_rows(path, header)
    else:
        raise ValueError(f"{path}: expected an ascii or binary_little_endian .ply that begins with its vertices; "
                         f"got {header.format}")
    points = columns(rows, MEANS).numpy()
    if not set(colors) <= set(names):
        return points, None
    return points, (columns(rows, colors) / (255 if rows.dtype["red"].kind == "u" else 1)).numpy()
