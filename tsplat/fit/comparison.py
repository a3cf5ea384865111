"""Images beside images: how like they are, and where they differ."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from tsplat.fit.evaluation import Quality
from tsplat.fit.losses import Target, psnr, ssim, target_of
from tsplat.scene import read_image, write_image

ERROR_GAIN = 4.0            # of a shown error: a quarter of full scale is white
SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff")


def error_picture(a: Tensor, b: Tensor) -> Tensor:
    """Four times the absolute difference of two images `[H, W, 3]` in 0..1, at most 1."""
    return (ERROR_GAIN * (a - b).abs()).clamp(max=1)


def compare(a: Path, b: Path, pictures: Path | None = None) -> dict[str, Quality]:
    """How like images are: PSNR (at most 100 dB) and SSIM, by the functions that `evaluate` uses.

    Args:
        a, b: two images, or two folders of images of the same names (suffixes may differ). The folder of a fit stands for the `test` in
            it, and a picture there for the render, its right half. Images with alpha are over black.
        pictures: where to write what is to be looked at, a beside b beside `error_picture`: a PNG for two images; for two folders a
            folder, made if need be, with one for each pair.

    Returns:
        The quality of each pair by its name: that of a's file, in a folder without the suffix.

    Raises:
        ValueError: a and b are of two kinds, or hold no images, or not the same ones, or ones of two sizes; naming the files.
        OSError: a file cannot be read or written.
    """
    qualities = {}
    for name, file_a, file_b in _pairs(a, b):
        image_a, image_b = _read(file_a), _read(file_b)
        if image_a.shape != image_b.shape:
            sizes = (f"{image.shape[1]}x{image.shape[0]}" for image in (image_a, image_b))
            raise ValueError(f"{file_a}, {file_b}: expected two images of one size; got {' and '.join(sizes)}")
        target = Target(image_b)
        qualities[name] = Quality(float(psnr(image_a, target)), float(ssim(image_a, target)))
        if pictures is not None:
            path = pictures / f"{name}.png" if a.is_dir() else pictures
            path.parent.mkdir(parents=True, exist_ok=True)
            write_image(path, torch.cat([image_a, image_b, error_picture(image_a, image_b)], dim=1))
    return qualities


def _pairs(a: Path, b: Path) -> Iterator[tuple[str, Path, Path]]:
    """Name, and file of both, of each pair."""
    for path in (a, b):
        if not path.exists():
            raise FileNotFoundError(f"{path}: expected an image or a folder of images; it does not exist")
    if a.is_dir() != b.is_dir():
        raise ValueError(f"{a}, {b}: expected two images or two folders; got one of each")
    if not a.is_dir():
        yield a.name, a, b
        return
    images_a, images_b = _images(a), _images(b)
    for path, missing in ((b, images_a.keys() - images_b.keys()), (a, images_b.keys() - images_a.keys())):
        if missing:
            some = ", ".join(sorted(missing)[:3]) + (", ..." if len(missing) > 3 else "")
            raise ValueError(f"{path}: expected an image for each in the other folder; {len(missing)} missing: {some}")
    for name in sorted(images_a):
        yield name, images_a[name], images_b[name]


def _images(folder: Path) -> dict[str, Path]:
    """The images in a folder, or in that of a fit, by name without suffix."""
    if _is_test(folder / "test"):
        folder = folder / "test"
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in SUFFIXES and not path.name.startswith("."):
            if path.stem in found:
                raise ValueError(f"{folder}: expected one image of a name; got {found[path.stem].name} and {path.name}")
            found[path.stem] = path
    if not found:
        raise ValueError(f"{folder}: expected images ({', '.join(SUFFIXES)}); found none")
    return found


def _is_test(folder: Path) -> bool:
    """Whether a folder holds what a fit rendered, beside the photos."""
    folder = folder.resolve()
    return folder.name == "test" and folder.is_dir() and (folder.parent / "metrics.json").is_file()


def _read(path: Path) -> Tensor:
    """`[H, W, 3]` in 0..1, over black; the right half if it is a render beside its photo."""
    image = target_of(read_image(path).float() / 255, torch.zeros(3), masked=False).image
    return image[:, image.shape[1] // 2:] if _is_test(path.parent) else image
