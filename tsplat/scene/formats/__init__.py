"""The file formats of Gaussians, found by the names of files; `Gaussians.load`, `Gaussians.save` and the command line share them."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tsplat.scene.formats.compressed_ply import is_compressed_ply, read_compressed_ply, write_compressed_ply
from tsplat.scene.formats.gltf import read_glb, write_glb
from tsplat.scene.formats.ksplat import read_ksplat
from tsplat.scene.formats.sog import META, is_sog, read_sog
from tsplat.scene.formats.splat import read_splat, write_splat
from tsplat.scene.formats.spz import read_spz, write_spz
from tsplat.scene.gaussians import Gaussians
from tsplat.scene.ply import read_ply, write_ply

__all__ = ["FORMATS", "Format", "find_format", "is_sog", "load", "save"]


@dataclass(frozen=True)
class Format:
    """A file format: its name, how names of its files end, and its functions (write: None if it can only be read)."""

    name: str
    suffix: str
    read: Callable[[Path], Gaussians]
    write: Callable[[Path, Gaussians], None] | None


PLY = Format("3DGS .ply", ".ply", read_ply, write_ply)
COMPRESSED_PLY = Format("PlayCanvas compressed .ply", ".compressed.ply", read_compressed_ply, write_compressed_ply)
SOG = Format("SOG", ".sog", read_sog, None)
FORMATS = (PLY, COMPRESSED_PLY, Format(".splat", ".splat", read_splat, write_splat), Format("SPZ", ".spz", read_spz, write_spz),
           Format("glTF, KHR_gaussian_splatting", ".glb", read_glb, write_glb), SOG, Format(".ksplat", ".ksplat", read_ksplat, None))


def find_format(path: str | os.PathLike[str], *, writing: bool = False) -> Format:
    """The format of a file, by its name; both kinds of .ply are told apart by their header when reading.

    Raises:
        ValueError: a name of no format, or of one that is not written where `writing`; a .ply that is none.
    """
    path = Path(path)
    matching = [item for item in FORMATS if path.name.lower().endswith(item.suffix) and (item.write is not None or not writing)]
    if is_sog(path) and not writing:
        return SOG
    if not matching:
        names = [item.suffix for item in FORMATS if item.write is not None] if writing else [*(item.suffix for item in FORMATS), META]
        raise ValueError(f"{path}: expected a file name that ends in {', '.join(names[:-1])} or {names[-1]}; got {path.suffix!r}")
    found = max(matching, key=lambda item: len(item.suffix))
    if found in (PLY, COMPRESSED_PLY) and not writing:
        return COMPRESSED_PLY if is_compressed_ply(path) else PLY
    return found


def load(path: str | os.PathLike[str]) -> Gaussians:
    """See `Gaussians.load`."""
    return find_format(path).read(Path(path))


def save(path: str | os.PathLike[str], gaussians: Gaussians) -> None:
    """See `Gaussians.save`."""
    write = find_format(path, writing=True).write
    assert write is not None
    write(Path(path), gaussians)
