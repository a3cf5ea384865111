"""Animated GIF files, written without a library: 252 fixed colours with ordered dithering, and LZW."""

from __future__ import annotations

import itertools
import os
import struct
from collections.abc import Iterable, Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tsplat.checks import check_tensor
from tsplat.scene.files import replacing

LEVELS = (6, 7, 6)             # of red, green and blue: 252 colours
MAX_CODE = 4096
BAYER = torch.tensor([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]]) / 16 + 1 / 32


def write_gif(path: str | os.PathLike[str], frames: Iterable[Tensor], fps: float = 25.0) -> None:
    """Write an endless animation, frame by frame. An older file stays until the new one is whole.

    Args:
        path: ends in `.gif`; its folder exists.
        frames: at least one, all `[H, W, 3]` in 0..1 (clamped) and of one size, of at most 65,535 pixels a side.
        fps: frames per second; a frame lasts a whole number of hundredths of a second.

    Raises:
        ValueError, TypeError: naming the argument.
        OSError: the file cannot be written.
    """
    if not os.fspath(path).lower().endswith(".gif"):
        raise ValueError(f"{os.fspath(path)}: expected a file name that ends in .gif")
    if not 0 < fps <= 100:
        raise ValueError(f"fps: expected above 0 and up to 100 frames per second in a GIF; got {fps}")
    height, width, frames = sized(frames)
    if not 1 <= min(height, width) <= max(height, width) < 1 << 16:
        raise ValueError(f"frames: expected 1 to 65535 pixels a side; got {width}x{height}")
    control = struct.pack("<BBBBHBB", 0x21, 0xF9, 4, 0, round(100 / fps), 0, 0)
    place = struct.pack("<BHHHHBB", 0x2C, 0, 0, width, height, 0, 8)
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(b"GIF89a" + struct.pack("<HHBBB", width, height, 0xF7, 0, 0) + _palette() + b"\x21\xFF\x0BNETSCAPE2.0\x03\x01\x00\x00\x00")
        for frame in frames:
            file.write(control + place + _blocks(_lzw(_indices(frame))) + b"\x00")
        file.write(b"\x3B")


def sized(frames: Iterable[Tensor]) -> tuple[int, int, Iterator[Tensor]]:
    """Height and width of the first frame `[H, W, 3]`, and all frames, each checked when it is taken: ValueError if it is of another size."""
    frames = iter(frames)
    first = next(frames, None)
    if first is None:
        raise ValueError("frames: expected at least 1 frame; got none")
    check_tensor("frames", first, ("H", "W", 3))

    def checked() -> Iterator[Tensor]:
        for frame in itertools.chain([first], frames):
            check_tensor("frames", frame, (*first.shape[:2], 3))
            yield frame

    return first.shape[0], first.shape[1], checked()


def _palette() -> bytes:
    """256 colours of 3 bytes, of which the last 4 are not used."""
    r, g, b = LEVELS
    colors = [(255 * i // (r - 1), 255 * j // (g - 1), 255 * k // (b - 1)) for i in range(r) for j in range(g) for k in range(b)]
    return bytes(value for color in colors for value in color) + bytes(3 * (256 - len(colors)))


def _indices(frame: Tensor) -> NDArray[np.uint8]:
    """`[H W]` colours of the palette: each channel is rounded up or down by a threshold that depends on the pixel."""
    frame = frame.detach().cpu().float().nan_to_num(0.0).clamp(0, 1)
    height, width = frame.shape[:2]
    threshold = BAYER.repeat(height // 4 + 1, width // 4 + 1)[:height, :width, None]
    top = torch.tensor(LEVELS) - 1
    level = torch.minimum((frame * top + threshold).floor().long(), top)                            # [H, W, 3]
    return np.asarray((level * torch.tensor([LEVELS[1] * LEVELS[2], LEVELS[2], 1])).sum(-1).flatten().numpy(), np.uint8)


def _lzw(indices: NDArray[np.uint8]) -> bytes:
    """Variable-width LZW with 8-bit symbols, as GIF wants it: codes from the lowest bit on, cleared when the table is full."""
    clear, end = 256, 257
    table: dict[tuple[int, int], int] = {}
    following, width, held, bits = end + 1, 9, clear, 9
    out = bytearray()
    prefix = -1
    for symbol in indices.tolist():
        if prefix < 0:
            prefix = symbol
            continue
        code = table.get((prefix, symbol))
        if code is not None:
            prefix = code
            continue
        held |= prefix << bits
        bits += width
        if following < MAX_CODE:
            table[prefix, symbol] = following
            following += 1
            width += following > 1 << width
        else:
            held |= clear << bits
            bits += width
            table.clear()
            following, width = end + 1, 9
        while bits >= 8:
            out.append(held & 255)
            held >>= 8
            bits -= 8
        prefix = symbol
    held |= prefix << bits
    bits += width
    following += 1                                       # the reader adds an entry for this code, too
    width += following > 1 << width and width < 12
    held |= end << bits
    bits += width
    return bytes(out) + held.to_bytes((bits + 7) // 8, "little")


def _blocks(data: bytes) -> bytes:
    """In pieces of up to 255 bytes, each after its length."""
    return b"".join(bytes([len(data[i:i + 255])]) + data[i:i + 255] for i in range(0, len(data), 255))
