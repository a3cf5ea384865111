"""Single image files: their size without decoding, reading, writing.

Decoding and encoding is done by kornia_rs, which kornia is built on, imported when first needed. (`kornia.io` itself, in the last version for
Python 3.10, reads no JPEG with the kornia_rs of today, and writes no alpha.)
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import BinaryIO

import torch
from torch import Tensor

from tsplat.checks import check_tensor
from tsplat.scene.files import replacing

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_COLOR_KIND = 25                                           # where in the file the colour type is
PNG_OPAQUE, PNG_INDEXED = (0, 2), 3                           # of these: grey, RGB; palette
JPEG_SIGNATURE = b"\xff\xd8"
JPEG_FRAME = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}      # the markers of a segment that holds the size
MODES = {1: "mono", 3: "rgb", 4: "rgba"}                      # of kornia_rs, by channels


def image_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """Width and height in pixels, as stored (EXIF orientation is ignored), from the header where it is a PNG or JPEG.

    Raises:
        ValueError: naming the file, if it is not an image.
        OSError: it cannot be opened.
    """
    path = Path(path)
    with path.open("rb") as file:
        head = file.read(24)
        if head.startswith(PNG_SIGNATURE) and len(head) == 24:
            return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")
        if head.startswith(JPEG_SIGNATURE):
            file.seek(2)
            size = _jpeg_size(file)
            if size is None:
                raise ValueError(f"{path}: expected a JPEG image; found none in it (truncated?)")
            return size
    height, width, _ = read_image(path).shape
    return width, height


def _jpeg_size(file: BinaryIO) -> tuple[int, int] | None:
    while len(segment := file.read(4)) == 4 and segment[0] == 0xFF:
        if segment[1] == 0xFF:                                # a fill byte
            file.seek(-3, os.SEEK_CUR)
        elif segment[1] in JPEG_FRAME:
            frame = file.read(5)                              # precision, height, width
            return (int.from_bytes(frame[3:5], "big"), int.from_bytes(frame[1:3], "big")) if len(frame) == 5 else None
        else:
            file.seek(int.from_bytes(segment[2:4], "big") - 2, os.SEEK_CUR)
    return None


def read_image(path: str | os.PathLike[str]) -> Tensor:
    """Decode a PNG, JPEG, TIFF or WebP file.

    Returns:
        `[H, W, 3]` uint8, or `[H, W, 4]` with the alpha that the file has (colours not multiplied by it).

    Raises:
        ValueError: naming the file, if it cannot be decoded.
        OSError: it cannot be opened.
    """
    from kornia_rs import io

    path = Path(path)
    with path.open("rb") as file:
        try:
            head = file.read(PNG_COLOR_KIND + 1)
            # `read_image` makes up what a JPEG lacks
            decode = io.read_image_jpegturbo if head.startswith(JPEG_SIGNATURE) else io.read_image
            image = torch.from_numpy(decode(os.fspath(path)))                      # [H, W, C]
            if head.startswith(PNG_SIGNATURE):
                image = _shown(image, head[PNG_COLOR_KIND], *_png_tables(file))
        except Exception as error:                                                 # kornia_rs raises bare exceptions, and OSErrors about contents
            raise ValueError(f"{path}: expected an image that can be decoded; {error}") from None
    if image.dtype == torch.uint16:
        image = (image.to(torch.float32) / 257).round().to(torch.uint8)
    if image.dtype != torch.uint8:
        raise ValueError(f"{path}: expected 8 or 16 bits per channel; got {image.dtype}")
    return image.expand(-1, -1, 3) if image.shape[2] == 1 else image


def _png_tables(file: BinaryIO) -> tuple[bytes, bytes]:
    """What PLTE and tRNS of a PNG contain, which come before its pixels; empty where they are not there. (Decoded, so its checksums are right.)"""
    tables = {b"PLTE": b"", b"tRNS": b""}
    file.seek(len(PNG_SIGNATURE))
    while len(head := file.read(8)) == 8 and head[4:] != b"IDAT":
        body = file.tell() + int.from_bytes(head[:4], "big")
        if head[4:] in tables:
            tables[head[4:]] = file.read(body - file.tell())
        file.seek(body + 4)
    return tables[b"PLTE"], tables[b"tRNS"]


def _shown(image: Tensor, kind: int, palette: bytes, transparency: bytes) -> Tensor:
    """The pixels `[H, W, C]` of a PNG of this colour type as it means them (PNG specification, 11.2.2 and 11.3.1.1): an index has a colour of the
    palette and its alpha, where it is listed; of grey and RGB the transparent colour, of 16 bits per channel, has alpha 0.
    """
    if kind == PNG_INDEXED:
        colors = torch.tensor(list(palette), dtype=torch.uint8).view(-1, 3)
        table = torch.cat([colors, torch.full_like(colors[:, :1], 255)], 1)
        table[:len(transparency), 3] = torch.tensor(list(transparency), dtype=torch.uint8)
        return table[image[..., 0].long()][..., :4 if transparency else 3]
    if kind in PNG_OPAQUE and len(transparency) == 2 * image.shape[2]:
        key = torch.tensor([int.from_bytes(transparency[i:i + 2], "big") for i in range(0, len(transparency), 2)])
        opaque = (image.to(torch.int32) != key).any(2, keepdim=True)
        alpha = opaque.to(torch.int32) * (255 if image.dtype == torch.uint8 else 65535)
        return torch.cat([image.expand(-1, -1, 3), alpha.to(image.dtype)], 2)
    return image


def write_image(path: str | os.PathLike[str], image: Tensor) -> None:
    """Write a PNG of 8 bits per channel. An older file stays until the new one is whole.

    Args:
        path: ends in `.png`; its folder exists.
        image: `[H, W, C]` floating point in 0..1 (clamped; NaN is written as 0), C = 1, 3 or 4; for 4, colours not
            multiplied by alpha.

    Raises:
        ValueError, TypeError: naming the argument.
        OSError: the file cannot be written; an old one stays as it was.
    """
    path = Path(path)
    check_tensor("image", image, ("H", "W", "C"))
    if image.shape[2] not in MODES or not image.numel():
        raise ValueError(f"image: expected [H, W, 1], [H, W, 3] or [H, W, 4] with pixels; got {list(image.shape)}")
    if path.suffix.lower() != ".png":
        raise ValueError(f"{path}: expected a file name that ends in .png; got {path.suffix!r}")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: expected the folder {path.parent} to exist")

    from kornia_rs.io import write_image_png_u8

    with replacing(path) as temporary:
        try:
            write_image_png_u8(os.fspath(temporary), to_bytes(image).contiguous().numpy(), MODES[image.shape[2]])
        except Exception as error:                                                 # kornia_rs raises bare exceptions
            raise OSError(f"{path}: cannot be written; {error}") from None


def to_bytes(image: Tensor) -> Tensor:
    """Floating point in 0..1 (clamped; NaN as 0) as uint8 of the same shape, on the CPU."""
    return image.detach().cpu().nan_to_num(0.0, 1.0, 0.0).clamp(0, 1).mul(255).round().to(torch.uint8)
