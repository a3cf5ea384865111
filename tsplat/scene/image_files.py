"""Single image files: their size without decoding, reading, writing. Decoding is kornia's, imported when first needed."""

from __future__ import annotations

import os
from pathlib import Path
from typing import BinaryIO

import torch
from torch import Tensor

from tsplat.checks import check_tensor
from tsplat.scene.files import replacing

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
JPEG_SIGNATURE = b"\xff\xd8"
JPEG_FRAME = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}      # the markers of a segment that holds the size


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
        FileNotFoundError: it does not exist.
    """
    from kornia.io import ImageLoadType, load_image

    path = Path(path)
    try:
        image = load_image(path, ImageLoadType.UNCHANGED)                          # [C, H, W]
        if image.shape[0] == 1 and image.dtype == torch.uint8:                     # grey, or the indices of a palette
            image = load_image(path, ImageLoadType.RGBA8)
            image = image[:3] if (image[3] == 255).all() else image
    except FileNotFoundError:
        raise
    except Exception as error:                                                     # kornia_rs raises bare exceptions too
        raise ValueError(f"{path}: expected an image that can be decoded; {error}") from None
    if image.dtype == torch.uint16:
        image = (image.to(torch.float32) / 257).round().to(torch.uint8)
    if image.dtype != torch.uint8:
        raise ValueError(f"{path}: expected 8 or 16 bits per channel; got {image.dtype}")
    return image.expand(3, -1, -1).permute(1, 2, 0) if image.shape[0] == 1 else image.permute(1, 2, 0)


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
    if image.shape[2] not in (1, 3, 4) or not image.numel():
        raise ValueError(f"image: expected [H, W, 1], [H, W, 3] or [H, W, 4] with pixels; got {list(image.shape)}")
    if path.suffix.lower() != ".png":
        raise ValueError(f"{path}: expected a file name that ends in .png; got {path.suffix!r}")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: expected the folder {path.parent} to exist")

    from kornia.io import write_image as write

    with replacing(path) as temporary:
        try:
            write(temporary, to_bytes(image).permute(2, 0, 1).contiguous())
        except Exception as error:                                                 # kornia_rs raises bare exceptions
            raise OSError(f"{path}: cannot be written; {error}") from None


def to_bytes(image: Tensor) -> Tensor:
    """Floating point in 0..1 (clamped; NaN as 0) as uint8 of the same shape, on the CPU."""
    return image.detach().cpu().nan_to_num(0.0, 1.0, 0.0).clamp(0, 1).mul(255).round().to(torch.uint8)
