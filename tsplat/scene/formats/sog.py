"""The SOG format of PlayCanvas, version 2: parameters as the pixels of lossless WebP images, with codebooks in a meta.json.

The files lie in a folder, or in a zip that is named .sog. Pixel i, row by row, is splat i. Axes are those of the .ply.
"""

from __future__ import annotations

import math
import os
import tempfile
import zipfile
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tsplat.scene.formats.checked import Json, malformed
from tsplat.scene.formats.fields import Fields, Floats, from_smallest_three, logits_of
from tsplat.scene.gaussians import Gaussians
from tsplat.scene.image_files import read_image

META = "meta.json"
VERSION = 2
LEVELS = 256                        # of a codebook
PALETTE_WIDTH = 64                  # entries of the palette of coefficients in a row of its image
FIRST_INDEX = 252                   # code of a rotation whose largest component is w
MAX_DEGREE = 3
MAX_PER_BYTE = 64                   # pixels or bytes that a byte of the files stands for; real scenes have less than 1
ROOM = 1 << 14                      # ... and what is let through in any case


def is_sog(path: Path) -> bool:
    """Whether the name says so: `*.sog`, a `meta.json`, or a folder with one and WebP images."""
    return path.suffix.lower() == ".sog" or path.name == META or ((path / META).is_file() and any(path.glob("*.webp")))


def read_sog(path: str | os.PathLike[str]) -> Gaussians:
    """Read a .sog file, or an unpacked one by its meta.json or folder.

    Returns:
        float32 Gaussians. Opacities of 0 and 255 get the logits +-16.

    Raises:
        ValueError: naming the file, where in it, and what is wrong. No image is decoded that has more pixels than the number of splats needs,
            no number of splats is believed that the size of the files cannot hold.
        OSError: a file cannot be read.
    """
    path = Path(path)
    with (_Zip(path) if path.suffix.lower() == ".sog" and not path.is_dir() else _Folder(path)) as files:
        return _decode(files)


class _Files:
    """The parts of a scene by name."""

    path: Path

    def __enter__(self) -> _Files:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def read(self, name: str) -> bytes:
        """The bytes of a part."""
        raise NotImplementedError

    def allowed(self) -> int:
        """Pixels or bytes that all parts together may turn out to have."""
        raise NotImplementedError


class _Folder(_Files):
    def __init__(self, path: Path) -> None:
        self.path = path if path.name == META else path / META
        self.folder = self.path.parent

    def read(self, name: str) -> bytes:
        return (self.folder / name).read_bytes()

    def allowed(self) -> int:
        return ROOM + MAX_PER_BYTE * sum(file.stat().st_size for file in self.folder.iterdir() if file.is_file())


class _Zip(_Files):
    def __init__(self, path: Path) -> None:
        self.path = path
        with path.open("rb"):                                                  # an OSError of its own, if any
            pass
        try:
            self.zip = zipfile.ZipFile(path)
        except (zipfile.BadZipFile, ValueError, OSError, NotImplementedError, EOFError) as error:
            raise malformed(path, 0, f"expected a .sog file, which is a zip; {error}") from None

    def __exit__(self, *error: object) -> None:
        self.zip.close()

    def read(self, name: str) -> bytes:
        try:
            info = self.zip.getinfo(name)
        except KeyError:
            raise malformed(self.path, 0, f"expected {name} in the zip; found {', '.join(self.zip.namelist()[:8]) or 'nothing'}") from None
        limit = self.allowed()
        try:
            with self.zip.open(info) as file:
                data = file.read(limit + 1)
                if len(data) <= limit and not file.read(1):                  # at the end the checksum is compared
                    return data
        except (zipfile.BadZipFile, zlib.error, ValueError, OSError, NotImplementedError, EOFError, RuntimeError) as error:
            raise malformed(self.path, info.header_offset, f"{name} cannot be unpacked; {error}") from None
        raise malformed(self.path, info.header_offset, f"expected at most {limit} bytes in {name}, {MAX_PER_BYTE} for each of the file")

    def allowed(self) -> int:
        return ROOM + MAX_PER_BYTE * self.path.stat().st_size


def _decode(files: _Files) -> Gaussians:
    meta = Json.parse(files.path, files.read(META))
    version, count = meta.get("version", int, 1), meta.get("count", int, -1)
    if version != VERSION:
        raise meta.wrong(f"expected SOG version {VERSION}; got {version}")
    if not 0 < count <= files.allowed():
        raise meta.wrong(f"expected a count of 1 to {files.allowed()} splats, which files of this size can hold; got {count}")

    low, high = (_pixels(files, meta, "means", i, count)[:count, :3].astype(np.uint32) for i in range(2))
    mins, maxs = (meta.at("means").numbers(key, 3) for key in ("mins", "maxs"))
    with np.errstate(over="ignore", invalid="ignore"):                       # bounds may be absurd
        places = mins + (maxs - mins) * ((low | high << 8) / 65535)
        means = (np.sign(places) * np.expm1(abs(places))).astype(np.float32)
    turns = _pixels(files, meta, "quats", 0, count)[:count]
    known = turns[:, 3] >= FIRST_INDEX
    quats = from_smallest_three(np.where(known, turns[:, 3] - np.int64(FIRST_INDEX), 0), (turns[:, :3] / 127.5 - 1) / math.sqrt(2))
    quats[~known] = 1, 0, 0, 0
    scales = _codebook(meta, "scales")[_pixels(files, meta, "scales", 0, count)[:count, :3]]
    colors = _pixels(files, meta, "sh0", 0, count)[:count]
    sh0 = _codebook(meta, "sh0")[colors[:, :3]]
    return Fields(means, quats, scales, logits_of(colors[:, 3] / 255), sh0, _harmonics(files, meta, count)).gaussians()


def _harmonics(files: _Files, meta: Json, count: int) -> Floats:
    """`[count, K - 1, 3]`: each splat has the label of an entry of a palette."""
    if "shN" not in meta.value:
        return np.empty((count, 0, 3), np.float32)
    harmonics = meta.at("shN")
    degree = harmonics.get("bands", int)
    if not 1 <= degree <= MAX_DEGREE:
        raise harmonics.wrong(f"expected 1 to {MAX_DEGREE} bands; got {degree}")
    rest = (degree + 1) ** 2 - 1
    palette = _pixels(files, meta, "shN", 0, None, width=PALETTE_WIDTH * rest)[:, :3].reshape(-1, rest, 3)     # a row has whole entries
    pixels = _pixels(files, meta, "shN", 1, count)[:count]
    labels = pixels[:, 0] | pixels[:, 1].astype(np.int64) << 8
    entries = min(len(palette), harmonics.get("count", int, len(palette)))
    if labels.max(initial=0) >= entries:
        raise harmonics.wrong(f"expected labels below {entries}, the entries of the palette; got {labels.max()}")
    coefficients: Floats = _codebook(meta, "shN")[palette][labels]
    return coefficients


def _codebook(meta: Json, key: str) -> Floats:
    with np.errstate(over="ignore"):
        levels: Floats = meta.at(key).numbers("codebook", LEVELS).astype(np.float32)
    return levels


def _pixels(files: _Files, meta: Json, key: str, index: int, count: int | None, width: int | None = None) -> NDArray[np.uint8]:
    """The pixels `[H W, 4]` of an image that has at least `count` of them, and not many more, or is so wide."""
    member = meta.at(key).at("files").at(index)
    name = member.value
    if not isinstance(name, str) or Path(name).name != name or "\\" in name or "\0" in name or name in ("", "..", META):
        raise member.wrong(f"expected the name of a file beside {META}; got {name!r}")
    data = files.read(name)
    size = _webp_size(data)
    if size is None:
        raise member.wrong(f"expected a lossless WebP image in {name}; got {data[:16]!r}")
    pixels = size[0] * size[1]
    if count is not None and not count <= pixels <= 4 * count + ROOM:
        raise member.wrong(f"expected an image of {count} pixels or a few more in {name}; got {size[0]}x{size[1]}")
    if width is not None and size[0] != width:
        raise member.wrong(f"expected an image {width} pixels wide in {name}; got {size[0]}x{size[1]}")
    if pixels > files.allowed():
        raise member.wrong(f"expected at most {files.allowed()} pixels in {name}, which files of this size can hold; got {size[0]}x{size[1]}")
    with tempfile.TemporaryDirectory() as folder:                            # the decoder takes a file, which in a zip there is none
        file = Path(folder) / "image.webp"
        file.write_bytes(data)
        try:
            image = read_image(file).numpy()
        except ValueError as error:
            raise member.wrong(f"{name} cannot be decoded; {str(error).partition('; ')[2]}") from None
    values = image.reshape(-1, image.shape[2])
    if len(values) != pixels:
        raise member.wrong(f"expected {size[0]}x{size[1]} pixels in {name}; got {list(image.shape)}")
    return values if values.shape[1] == 4 else np.pad(values, ((0, 0), (0, 1)), constant_values=255)     # opaque images are stored without


def _webp_size(data: bytes) -> tuple[int, int] | None:
    """Width and height of a lossless WebP image, from the header that the decoder goes by; None if it is none."""
    if data[:4] != b"RIFF" or data[8:12] != b"WEBP":
        return None
    position = 12
    while position + 13 <= len(data):                                        # chunks of kind, size and, if it is the image, 0x2f and 28 bits
        kind, size = data[position:position + 4], int.from_bytes(data[position + 4:position + 8], "little")
        if kind == b"VP8L" and data[position + 8] == 0x2F:
            bits = int.from_bytes(data[position + 9:position + 13], "little")
            return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
        if kind not in (b"VP8X", b"ICCP"):
            return None
        position += 8 + size + size % 2
    return None
