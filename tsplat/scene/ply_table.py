"""Tables of numbers in .ply files: the rows of the element `vertex`, column by column."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tsplat.scene.files import replacing

SCALARS = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8",
           "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4",
           "float64": "f8"}
MAX_HEADER = 1 << 20            # bytes


@dataclass
class Header:
    """What a .ply file says of itself."""

    format: str
    elements: dict[str, tuple[int, list[tuple[str, str]]]]      # name -> rows, [(property, numpy type)]; "list" for a list
    size: int                                                   # bytes up to the data
    comments: list[str]


def read_header(path: Path) -> Header:
    """The header; ValueError if the file does not begin with one that has an element `vertex`."""
    with path.open("rb") as file:
        lines = _header_lines(path, file)
        size = file.tell()
    header = Header("", {}, size, [])
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
            case ["comment", *words]:
                header.comments.append(" ".join(words))
            case [] | ["obj_info" | "ply", *_]:
                pass
            case _:
                raise ValueError(f"{path}: expected a .ply header line; got {line[:80]!r}")
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


def binary_rows(path: Path, header: Header, name: str = "vertex") -> NDArray[Any]:
    """The rows of an element, `[N]` structured; ValueError if the file is shorter or longer than its header says.

    Lists may only follow the element; then the end of the file is not known.
    """
    end = header.size
    ends = {}
    lists = False
    for element, (rows, properties) in header.elements.items():
        lists = lists or (name in ends and any(kind == "list" for _, kind in properties))
        if not lists:
            end += rows * row_type(path, element, properties).itemsize
            ends[element] = end
    count, properties = header.elements[name]
    row, found = row_type(path, name, properties), path.stat().st_size
    if found < end:
        raise ValueError(f"{path}: truncated: expected {end} bytes for {count} rows of `{name}`; found {found}")
    if found > end and not lists:
        raise ValueError(f"{path}: at byte {end}: oversized: expected the end; found {found - end} more bytes")
    return np.fromfile(path, dtype=row, count=count, offset=ends[name] - count * row.itemsize)


def row_type(path: Path, element: str, properties: list[tuple[str, str]]) -> np.dtype[Any]:
    """The type of a row of an element; ValueError if it has lists or columns of the same name."""
    if any(kind == "list" for _, kind in properties):
        raise ValueError(f"{path}: lists in or before the element `vertex` are not supported; found one in `{element}`")
    try:
        return np.dtype(properties)
    except ValueError as error:
        raise ValueError(f"{path}: the columns of `{element}` are not distinct: {error}") from None


def columns(rows: NDArray[Any], names: tuple[str, ...]) -> torch.Tensor:
    """`[N, len(names)]` float32."""
    table = np.empty((len(rows), len(names)), dtype=np.float32)
    for i, name in enumerate(names):
        table[:, i] = rows[name]
    return torch.from_numpy(table)


def write_columns(path: str | os.PathLike[str], names: Sequence[str], rows: Tensor, comment: str | None = None) -> None:
    """Write rows `[N, len(names)]` as little-endian float32. The new file takes the place of an old one only when it is whole."""
    header = "\n".join(["ply", "format binary_little_endian 1.0", *([] if comment is None else [f"comment {comment}"]),
                        f"element vertex {len(rows)}", *(f"property float {name}" for name in names), "end_header\n"])
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(header.encode("ascii"))
        file.write(rows.detach().cpu().numpy().astype("<f4").tobytes())
