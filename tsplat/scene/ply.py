"""The 3DGS .ply format: raw parameters as float32 columns, one row per Gaussian, `f_rest` channel by channel."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray

from tsplat.scene.files import replacing
from tsplat.scene.gaussians import MAX_SH_DEGREE, Gaussians

SCALARS = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8",
           "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4",
           "float64": "f8"}
MEANS, NORMALS, DC = ("x", "y", "z"), ("nx", "ny", "nz"), ("f_dc_0", "f_dc_1", "f_dc_2")
SCALES, QUATS = ("scale_0", "scale_1", "scale_2"), ("rot_0", "rot_1", "rot_2", "rot_3")
MAX_LOGIT = 16.0                # stands for an infinite logit, which quantised formats give for opacity 0 and 1
MAX_HEADER = 1 << 20            # bytes


@dataclass
class _Header:
    format: str
    elements: dict[str, tuple[int, list[tuple[str, str]]]]      # name -> rows, [(property, numpy type)]; "list" for a list
    size: int                                                   # bytes up to the data


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
    header = _read_header(path)
    _, properties = header.elements["vertex"]
    columns = [name for name, _ in properties]
    if "chunk" in header.elements or "packed_position" in columns:
        raise ValueError(f"{path}: this is a PlayCanvas compressed .ply; expected a plain 3DGS .ply (convert it first)")
    if header.format != "binary_little_endian":
        raise ValueError(f"{path}: expected a binary_little_endian .ply of Gaussians; got {header.format}")
    missing = [name for name in (*MEANS, *DC, "opacity", *SCALES, *QUATS) if name not in columns]
    if missing:
        raise ValueError(f"{path}: a 3DGS .ply needs the columns {', '.join(missing)}; this one has {', '.join(columns)}")
    rest = sum(name.startswith("f_rest_") for name in columns)
    rest_names = tuple(f"f_rest_{i}" for i in range(rest))
    degrees = {3 * ((degree + 1) ** 2 - 1): degree for degree in range(MAX_SH_DEGREE + 1)}
    if rest not in degrees or not set(rest_names) <= set(columns):
        raise ValueError(f"{path}: expected {', '.join(map(str, degrees))} columns f_rest_0, f_rest_1, ...; got {rest}")

    rows = _binary_vertices(path, header)
    logits = _columns(rows, ("opacity",))[:, 0]
    logits = torch.where(logits.isinf(), logits.sign() * MAX_LOGIT, logits)
    sh_rest = _columns(rows, rest_names).view(len(rows), 3, rest // 3).transpose(1, 2)      # channel-major in the file
    return Gaussians(_columns(rows, MEANS), _columns(rows, QUATS), _columns(rows, SCALES), logits,
                     _columns(rows, DC)[:, None], sh_rest)


def write_ply(path: str | os.PathLike[str], gaussians: Gaussians) -> None:
    """Write a 3DGS .ply (float32, little endian, zero normals, as the Inria code orders its columns).

    The new file takes the place of an old one only when it is whole.

    Raises:
        OSError: the file cannot be written; an old one stays as it was.
    """
    n = len(gaussians)
    rest = gaussians.sh_rest.transpose(1, 2).flatten(1)                                     # [N, 3 (K - 1)] channel-major
    names = (*MEANS, *NORMALS, *DC, *(f"f_rest_{i}" for i in range(rest.shape[1])), "opacity", *SCALES, *QUATS)
    rows = torch.cat([gaussians.means, torch.zeros_like(gaussians.means), gaussians.sh0.flatten(1), rest,
                      gaussians.opacity_logits[:, None], gaussians.log_scales, gaussians.quats], dim=1)
    header = "\n".join(["ply", "format binary_little_endian 1.0", f"element vertex {n}",
                        *(f"property float {name}" for name in names), "end_header\n"])
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(header.encode("ascii"))
        file.write(rows.detach().cpu().numpy().astype("<f4").tobytes())


def read_point_ply(path: str | os.PathLike[str]) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """Read the points of an ascii or little-endian .ply: `[M, 3]` positions and `[M, 3]` colours in 0..1 (None without).

    Raises:
        ValueError: as `read_ply`.
    """
    path = Path(path)
    header = _read_header(path)
    count, properties = header.elements["vertex"]
    columns = [name for name, _ in properties]
    colors = ("red", "green", "blue")
    if not set(MEANS) <= set(columns):
        raise ValueError(f"{path}: a point cloud needs the columns x, y, z; this one has {', '.join(columns)}")
    if header.format == "ascii" and next(iter(header.elements)) == "vertex":
        with path.open("rb") as file:
            file.seek(header.size)
            table = np.loadtxt(file, dtype=np.float64, max_rows=count, ndmin=2) if count else np.empty((0, len(columns)))
        if table.shape != (count, len(columns)):
            raise ValueError(f"{path}: expected {count} rows of {len(columns)} numbers; got {list(table.shape)}")
        rows = np.empty(count, _row_type(path, "vertex", properties))
        for i, column in enumerate(columns):
            rows[column] = table[:, i]
    elif header.format == "binary_little_endian":
        rows = _binary_vertices(path, header)
    else:
        raise ValueError(f"{path}: expected an ascii or binary_little_endian .ply that begins with its vertices; "
                         f"got {header.format}")
    points = _columns(rows, MEANS).numpy()
    if not set(colors) <= set(columns):
        return points, None
    return points, (_columns(rows, colors) / (255 if rows.dtype["red"].kind == "u" else 1)).numpy()


def _read_header(path: Path) -> _Header:
    with path.open("rb") as file:
        lines = _header_lines(path, file)
        size = file.tell()
    header = _Header("", {}, size)
    properties: list[tuple[str, str]] = []
    for line in lines:
        match line.split():
            case ["format", kind, _]:
                header.format = kind
            case ["element", name, count] if count.isdigit():
                properties = []
                header.elements[name] = int(count), properties
            case ["property", "list", _, _, name]:
                properties.append((name, "list"))
            case ["property", kind, name] if kind in SCALARS:
                properties.append((name, "<" + SCALARS[kind]))
            case [] | ["comment" | "obj_info" | "ply", *_]:
                pass
            case _:
                raise ValueError(f"{path}: expected a .ply header line; got {line!r}")
    if "vertex" not in header.elements:
        raise ValueError(f"{path}: expected an element `vertex`; got {', '.join(header.elements) or 'no element'}")
    return header


def _header_lines(path: Path, file: BinaryIO) -> list[str]:
    if file.read(3) != b"ply":
        raise ValueError(f"{path}: expected a .ply file, which begins with `ply`")
    lines: list[str] = []
    while (line := file.readline(1024)) and file.tell() < MAX_HEADER:
        text = line.decode("ascii", errors="replace").strip()
        if text == "end_header":
            return lines
        lines.append(text)
    raise ValueError(f"{path}: the .ply header has no end_header line")


def _binary_vertices(path: Path, header: _Header) -> NDArray[Any]:
    """The rows of the vertex element, `[N]` structured."""
    offset = header.size
    for name, (count, properties) in header.elements.items():
        row = _row_type(path, name, properties)
        if name == "vertex":
            break
        offset += count * row.itemsize
    expected, found = offset + count * row.itemsize, path.stat().st_size
    if found < expected:
        raise ValueError(f"{path}: truncated: expected {expected} bytes for {count} vertices; found {found}")
    return np.fromfile(path, dtype=row, count=count, offset=offset)


def _row_type(path: Path, element: str, properties: list[tuple[str, str]]) -> np.dtype[Any]:
    if any(kind == "list" for _, kind in properties):
        raise ValueError(f"{path}: lists in or before the element `vertex` are not supported; found one in `{element}`")
    try:
        return np.dtype(properties)
    except ValueError as error:
        raise ValueError(f"{path}: the columns of `{element}` are not distinct: {error}") from None


def _columns(rows: NDArray[Any], names: tuple[str, ...]) -> torch.Tensor:
    """`[N, len(names)]` float32."""
    table = np.empty((len(rows), len(names)), dtype=np.float32)
    for i, name in enumerate(names):
        table[:, i] = rows[name]
    return torch.from_numpy(table)
