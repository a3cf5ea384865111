"""The .spz format of Niantic: one array per parameter, quantised to 8 to 32 bits and compressed (github.com/nianticlabs/spz).

Versions 2 and 3 are one gzip stream: a header of 16 bytes, then the arrays of `_layout`. Version 4 has a header of 32 bytes, a table of sizes and
one zstd frame per array. Axes are x right, y up, z back.
"""

from __future__ import annotations

import math
import os
import struct
import warnings
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsplat.scene.files import replacing
from tsplat.scene.formats.checked import Reader, malformed
from tsplat.scene.formats.fields import UP_AND_BACK, Fields, from_smallest_three, logits_of, opacities_of, rounded, smallest_three
from tsplat.scene.gaussians import MAX_SH_DEGREE, Gaussians

HEADER = struct.Struct("<4sIIBBBB")             # magic, version, splats, SH degree, fractional bits, flags, reserved (4: number of frames)
HEADER_4 = struct.Struct("<I12x")               # what follows in version 4: where the table of sizes is
ENTRY_4 = struct.Struct("<QQ")                  # of that table: bytes compressed, bytes
MAGIC = b"NGSP"
ANTIALIASED, EXTENDED = 1, 2                    # flags
MAX_EXTENSIONS = 1 << 16                        # bytes
MAX_FACTOR = 1032                               # by which deflate can compress; splats are never as uniform, whatever the method
FRACTIONAL_BITS = 12                            # of means, as the authors' program writes them
COLOR = 0.15                                    # code of a colour: 0.5 + 0.15 sh0
SH_BUCKETS = (8, 16)                            # steps of the codes of degree 1 and above that are written: 5 and 4 bits of 8


def read_spz(path: str | os.PathLike[str]) -> Gaussians:
    """Read an .spz file of version 2, 3 or 4 (4 needs the package zstandard: `pip install 'tsplat[spz]'`).

    Returns:
        float32 Gaussians of degree 0 to 4 with the axes of a .ply. Opacities of 0 and 255 get the logits +-16. Extensions are passed over
        with a warning.

    Raises:
        ValueError: naming the file, where in it, and what is wrong. No more is decompressed than the number of splats needs.
        ImportError: version 4 without zstandard.
        OSError: the file cannot be read.
    """
    path = Path(path)
    data = path.read_bytes()
    if data[:2] == b"\x1f\x8b":
        return _read_gzip(path, data)
    reader = Reader(path, data)
    version, count, degree, bits, flags, frames = _header(path, reader.take(HEADER.size, "the header"))
    if version == 4:
        return _read_frames(reader, count, degree, bits, flags, frames)
    return _decode(Reader(path, data[HEADER.size:], HEADER.size), version, count, degree, bits, flags)


def write_spz(path: str | os.PathLike[str], gaussians: Gaussians, version: int = 3) -> None:
    """Write an .spz file, in the order of `gaussians`. The new file takes the place of an old one only when it is whole.

    Steps: means 1/4096 (more where they are beyond 2047), log scales 1/16 in -10..5.94, opacities 1/255, sh0 1/38.25 within +-3.33, other
    coefficients 1/16 (degree 1) and 1/8 within +-1, rotations 1/511 (version 2: 1/127.5). What a file cannot hold is left out with a warning.

    Args:
        path: of the file.
        gaussians: of any degree.
        version: 2 or 3.

    Raises:
        ValueError: another version, or means beyond 4194304.
        OSError: the file cannot be written; an old one stays as it was.
    """
    if version not in (2, 3):
        raise ValueError(f"version: expected 2 or 3; got {version!r}")
    fields = Fields.of(path, gaussians, MAX_SH_DEGREE).turned(UP_AND_BACK)
    farthest = float(abs(fields.means).max(initial=0))
    bits = FRACTIONAL_BITS if farthest < 2047 else 22 - math.ceil(math.log2(farthest))
    if bits < 0:
        raise ValueError(f"{os.fspath(path)}: .spz holds means up to 4194304; got {farthest:g}")
    fixed = np.round(fields.means.astype(np.float64) * 2.0 ** bits).astype("<i4")
    quats = np.roll(fields.quats, -1, axis=1)                                      # xyzw
    if version == 2:
        rotations = rounded(127.5 * np.where(quats[:, 3:] < 0, -quats[:, :3], quats[:, :3]) + 127.5, 255).astype("u1")
    else:
        largest, small = smallest_three(quats)
        codes = rounded(abs(small) * (511 * math.sqrt(2)), 511) | (small < 0).astype(np.uint32) << 9
        rotations = (largest << 30 | codes[:, 0] << 20 | codes[:, 1] << 10 | codes[:, 2]).astype("<u4")
    coefficients = np.floor(128 * fields.sh_rest.clip(-2, 2) + 128.5)
    for bucket, part in zip(SH_BUCKETS, (coefficients[:, :3], coefficients[:, 3:]), strict=True):
        part[:] = (part + bucket // 2) // bucket * bucket
    arrays = [fixed.view("u1").reshape(-1, 3, 4)[..., :3], rounded(255 * opacities_of(fields.logits), 255).astype("u1"),
              rounded(255 * (COLOR * fields.sh0 + 0.5), 255).astype("u1"), rounded(16 * (fields.log_scales + 10), 255).astype("u1"),
              rotations, coefficients.clip(0, 255).astype("u1")]
    header = HEADER.pack(MAGIC, version, len(fields), fields.degree, bits, 0, 0)
    gzip = zlib.compressobj(wbits=31)
    with replacing(path) as temporary:
        temporary.write_bytes(b"".join([*map(gzip.compress, [header, *(array.tobytes() for array in arrays)]), gzip.flush()]))


def _header(path: Path, data: bytes) -> tuple[int, int, int, int, int, int]:
    """Version, splats, degree, fractional bits, flags, last byte."""
    magic, version, count, degree, bits, flags, last = HEADER.unpack(data)
    if magic != MAGIC:
        raise malformed(path, 0, f"expected an .spz file, which begins with {MAGIC!r} (or the same in gzip); got {magic!r}")
    if version not in (2, 3, 4):
        raise malformed(path, 4, f"expected .spz version 2, 3 or 4; got {version}")
    if degree > MAX_SH_DEGREE:
        raise malformed(path, 12, f"expected spherical harmonics of degree 0 to {MAX_SH_DEGREE}; got {degree}")
    if bits > 24:
        raise malformed(path, 13, f"expected at most 24 fractional bits of 24; got {bits}")
    if flags & EXTENDED:
        warnings.warn(f"{path}: its extensions are not known and passed over; the scene may look different")
    if flags & ANTIALIASED:
        warnings.warn(f"{path}: fitted with antialiasing, and is to be rendered with it")
    return version, count, degree, bits, flags, last


def _layout(version: int, degree: int) -> dict[str, tuple[str, tuple[int, ...]]]:
    """The arrays in their order: name -> (dtype, shape of a row)."""
    rotations = ("u1", (3,)) if version == 2 else ("<u4", (1,))
    rest = ((degree + 1) ** 2 - 1, 3)
    return {"means": ("u1", (3, 3)), "opacities": ("u1", (1,)), "colors": ("u1", (3,)), "scales": ("u1", (3,)), "rotations": rotations,
            "harmonics": ("u1", rest)}


def _row_sizes(version: int, degree: int) -> list[int]:
    return [np.dtype(kind).itemsize * math.prod(row) for kind, row in _layout(version, degree).values()]


def _read_gzip(path: Path, data: bytes) -> Gaussians:
    inflater = zlib.decompressobj(wbits=31)
    pending = data

    def inflate(size: int) -> bytes:
        """At most the next `size` > 0 bytes."""
        nonlocal pending
        try:
            out = inflater.decompress(pending, size)
        except zlib.error as error:
            raise malformed(path, len(data) - len(pending), f"expected gzip; {error}") from None
        pending = inflater.unconsumed_tail
        return out

    header = Reader(path, inflate(HEADER.size)).take(HEADER.size, "the header in gzip")
    version, count, degree, bits, flags, _ = _header(path, header)
    if version == 4:
        raise malformed(path, 4, "expected version 2 or 3 in gzip; got 4")
    size = count * sum(_row_sizes(version, degree))
    _check_factor(path, size, len(data))
    body = inflate(size) if size else b""
    tail = inflate(MAX_EXTENSIONS if flags & EXTENDED else 1) if len(body) == size else b""
    if (tail and not flags & EXTENDED) or (not inflater.eof and len(body) == size):
        raise malformed(path, len(data) - len(pending), f"expected {HEADER.size + size} bytes in gzip for {count} splats; found "
                        f"{'more' if tail else 'no end'}")
    if inflater.unused_data:
        raise malformed(path, len(data) - len(inflater.unused_data), "oversized: expected the end of the file after its gzip stream")
    return _decode(Reader(path, body, HEADER.size), version, count, degree, bits, 0)


def _read_frames(reader: Reader, count: int, degree: int, bits: int, flags: int, frames: int) -> Gaussians:
    path = reader.path
    try:
        import zstandard
    except ImportError as error:
        raise ImportError(f"{path}: an .spz file of version 4 needs the package zstandard: pip install 'tsplat[spz]' ({error})") from None
    table, = HEADER_4.unpack(reader.take(HEADER_4.size, "the header"))
    if table < reader.position:
        raise malformed(path, HEADER.size, f"expected the table of sizes behind the header of {reader.position} bytes; got {table}")
    reader.take(table - reader.position, "extensions")
    sizes = [count * size for size in _row_sizes(4, degree) if size]
    if frames != len(sizes):
        raise malformed(path, HEADER.size - 1, f"expected {len(sizes)} zstd frames for degree {degree}; got {frames}")
    _check_factor(path, sum(sizes), len(reader.data))
    entries = [ENTRY_4.unpack(reader.take(ENTRY_4.size, "the table of sizes")) for _ in sizes]
    arrays = []
    for size, (compressed, announced) in zip(sizes, entries, strict=True):
        offset = reader.offset
        frame = reader.take(compressed, "a zstd frame")
        if announced != size:
            raise malformed(path, offset, f"expected a zstd frame of {size} bytes for {count} splats; the table says {announced}")
        # Read as a stream: `decompress` would believe what the frame says of its size.
        stream = zstandard.ZstdDecompressor(max_window_size=max(1 << 23, size)).stream_reader(frame)
        try:
            array = stream.read(size + 1)
        except (zstandard.ZstdError, MemoryError) as error:
            raise malformed(path, offset, f"expected a zstd frame; {error}") from None
        if len(array) != size:
            raise malformed(path, offset, f"expected {size} bytes in a zstd frame for {count} splats; found {min(len(array), size + 1)}")
        arrays.append(array)
    if not flags & EXTENDED:
        reader.end()
    return _decode(Reader(path, b"".join(arrays)), 4, count, degree, bits, 0)


def _check_factor(path: Path, size: int, file_size: int) -> None:
    if size > MAX_FACTOR * file_size:
        raise malformed(path, 8, f"expected at most {MAX_FACTOR} times the file's {file_size} bytes; its number of splats needs {size}")


def _decode(reader: Reader, version: int, count: int, degree: int, bits: int, flags: int) -> Gaussians:
    """The arrays that `reader` is at, which are followed by extensions if `flags` says so."""
    size = count * sum(_row_sizes(version, degree))
    if len(reader.data) < size:
        raise malformed(reader.path, reader.offset + len(reader.data),
                        f"truncated: expected {size} bytes for {count} splats; found {len(reader.data)}")
    arrays: dict[str, NDArray[Any]] = {name: reader.array(kind, (count, *row), name) for name, (kind, row) in _layout(version, degree).items()}
    if not flags & EXTENDED:
        reader.end()
    low, middle, high = (arrays["means"][..., i].astype(np.int32) for i in range(3))
    fixed = ((low | middle << 8 | high << 16) ^ 0x800000) - 0x800000              # the sign is bit 23
    if version == 2:
        xyz = arrays["rotations"] / 127.5 - 1
        quats = np.concatenate([np.sqrt((1 - np.square(xyz).sum(1, keepdims=True)).clip(0, None)), xyz], 1).astype(np.float32)
    else:
        code = arrays["rotations"]                                                # [N, 1]: index, then 3 times sign and 9 bits
        parts = code >> np.array([20, 10, 0], np.uint32)
        small = (parts & 511) / (511 * math.sqrt(2)) * np.where(parts & 512, -1, 1)
        quats = np.roll(from_smallest_three((code[:, 0] >> 30).astype(np.int64), small), 1, axis=1)     # from xyzw
    fields = Fields((fixed / 2.0 ** bits).astype(np.float32), quats, arrays["scales"].astype(np.float32) / 16 - 10,
                    logits_of(arrays["opacities"][:, 0] / 255), ((arrays["colors"] / 255 - 0.5) / COLOR).astype(np.float32),
                    arrays["harmonics"].astype(np.float32) / 128 - 1)
    return fields.turned(UP_AND_BACK).gaussians()
