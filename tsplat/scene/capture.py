"""`Capture`: posed photos, and `load_capture`, which recognises how a folder of them is laid out."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from tsplat.camera import Camera
from tsplat.scene.colmap import is_colmap, read_colmap
from tsplat.scene.image_files import image_size
from tsplat.scene.images import CACHE_BYTES, ImageStore, Photo, read_depth
from tsplat.scene.transforms import read_transforms
from tsplat.scene.view import Points, View

COLMAP_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", ".")
TRANSFORMS_FILES = ("transforms_train.json", "transforms.json")


@dataclass
class Capture:
    """C posed photos, sorted by name, all undistorted and of the size asked for.

    Args:
        names: of the photos.
        viewmats: `[C, 4, 4]` float32, world to camera, OpenCV axes.
        Ks: `[C, 3, 3]` float32, intrinsics in pixels of the images as they come from `images`.
        width, height: of each image, in pixels; images may differ in size.
        images: `images[i]` is `[H, W, 3]`, or `[H, W, 4]` with alpha or a mask.
        train, test: indices of the photos to train on and of those held out.
        points: `[M, 3]` float32 sparse points, or None.
        point_colors: `[M, 3]` float32 in 0..1, or None.
        masked: whether a fourth channel comes from mask files (0 = leave this pixel out of the loss) rather than from
            the photos' own alpha (0 = nothing there, the background shows).
        depths: files of depth maps, by photo (see `depth`); empty where there are none at all.
    """

    names: list[str]
    viewmats: Tensor
    Ks: Tensor
    width: list[int]
    height: list[int]
    images: ImageStore
    train: list[int]
    test: list[int]
    points: Tensor | None = None
    point_colors: Tensor | None = None
    masked: bool = False
    depths: list[Path | None] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.names)

    def camera(self, index: int) -> Camera:
        """The pinhole camera of photo `index`, for the image `images[index]`."""
        return Camera(self.viewmats[index], self.Ks[index], self.width[index], self.height[index])

    def depth(self, index: int, width: int, height: int) -> Tensor | None:
        """The depth map of photo `index`, `[height, width]` float32: camera z, unknown where not finite or not above 0.

        None where the photo has none. Nearest samples, so that no depth is made up between a foreground and a background.

        Raises:
            ValueError: naming the file, if it is no array `[h, w]` of numbers.
        """
        path = self.depths[index] if self.depths else None
        return None if path is None else read_depth(path, width, height)

    @property
    def has_points(self) -> bool:
        """Whether there are sparse points to start from."""
        return self.points is not None and len(self.points) > 0

    @property
    def extent(self) -> float:
        """1.1 times the largest distance of a camera from the mean camera position; 1 if all are at one place."""
        rotations, translations = self.viewmats[:, :3, :3], self.viewmats[:, :3, 3:]
        centres = -(rotations.mT @ translations).squeeze(-1)                              # [C, 3]
        return 1.1 * float((centres - centres.mean(0)).norm(dim=1).max()) or 1.0


def load_capture(path: str | os.PathLike[str], *, downscale: float = 1, test_every: int = 8,
                 cache_bytes: int = CACHE_BYTES) -> Capture:
    """Read the capture in a folder: a COLMAP model with photos, NeRF-synthetic, instant-ngp or nerfstudio.

    Recognised, in this order: a COLMAP model in `sparse/0`, `sparse`, `colmap/sparse/0` or `path` itself, with the photos
    in `images`; `transforms_train.json` (with `transforms_test.json` as the photos held out); `transforms.json`. Masks
    are `masks/<photo>.png`, `<photo>.mask.png` or `<stem>_mask.png` beside the photo, or the JSON's `mask_path`. Depth maps,
    for undistorted photos, are `depths/<photo>.npy` or `depths/<stem>.npy` beside the folder of the photos.

    Args:
        path: the folder, or a JSON file.
        downscale: at least 1; the size of the images is divided by it. Photos in `images_<downscale>` are used as they are.
        test_every: photo i of the photos in the order of their names is held out if i % test_every == 0; 0 holds out none.
        cache_bytes: bound of the memory in which decoded images are kept.

    Raises:
        FileNotFoundError: `path` does not exist, holds nothing known (the message lists what was looked for), or the
            model has no photos. If only some are missing, they are skipped with one warning.
        ValueError: a broken file, a photo that is no image or of another shape than its camera, a bad option.
    """
    path = Path(path)
    if not downscale >= 1:
        raise ValueError(f"downscale: expected at least 1; got {downscale}")
    if test_every < 0:
        raise ValueError(f"test_every: expected 0 (none) or more; got {test_every}")
    if not path.exists():
        raise FileNotFoundError(f"{path}: expected a folder with a capture; it does not exist")
    views, points, held_out = _read(path, downscale)
    order = sorted(range(len(views)), key=lambda i: views[i].name)
    views = [views[i] for i in order]
    if held_out:
        test = [i for i, view in enumerate(views) if view.name in held_out]
    else:
        test = list(range(0, len(views), test_every)) if test_every else []
    prepared = [_prepare(view, downscale) for view in views]
    photos = [photo for photo, _ in prepared]
    xyz, rgb = points if points is not None else (None, None)
    return Capture(
        names=[view.name for view in views],
        viewmats=torch.from_numpy(np.stack([view.viewmat for view in views])).to(torch.float32),
        Ks=torch.stack([K for _, K in prepared]),
        width=[photo.width for photo in photos],
        height=[photo.height for photo in photos],
        images=ImageStore(photos, cache_bytes),
        train=sorted(set(range(len(views))) - set(test)),
        test=test,
        points=None if xyz is None else torch.from_numpy(xyz),
        point_colors=None if rgb is None else torch.from_numpy(rgb),
        masked=any(photo.mask is not None for photo in photos),
        depths=_depth_files(views),
    )


def _read(path: Path, downscale: float) -> tuple[list[View], Points | None, set[str]]:
    """Views whose photos exist, the points, and the names that the files themselves hold out."""
    if path.is_file():
        if path.suffix.lower() != ".json":
            raise ValueError(f"{path}: expected a folder or a .json file")
        return *read_transforms(path), set()
    for folder in COLMAP_FOLDERS:
        if is_colmap(path / folder):
            return *_read_colmap(path / folder, path, downscale), set()
    for name in TRANSFORMS_FILES:
        if (path / name).is_file():
            views, points = read_transforms(path / name)
            test = path / "transforms_test.json"
            held_out = read_transforms(test)[0] if name == "transforms_train.json" and test.is_file() else []
            return views + held_out, points, {view.name for view in held_out}
    looked = [f"{folder}/cameras.bin" for folder in COLMAP_FOLDERS] + [f"{folder}/cameras.txt" for folder in COLMAP_FOLDERS]
    raise FileNotFoundError(f"{path}: found no capture; looked for {', '.join([*looked, *TRANSFORMS_FILES])}")


def _read_colmap(model: Path, root: Path, downscale: float) -> tuple[list[View], Points]:
    folders = [root / "images"]
    if model.resolve() == root.resolve():                          # given the model's own folder: the photos lie further up
        folders += [parent / "images" for parent in list(root.resolve().parents)[:3]]
    images = next((folder for folder in folders
                   if folder.is_dir() or folder.with_name(f"images_{downscale:g}").is_dir()), None)
    if images is None:
        raise FileNotFoundError(f"{root}: a COLMAP model needs its photos; looked for {', '.join(map(str, folders))}")
    views, points = read_colmap(model, images)
    present = [view for view in views if view.photo(downscale)[0].is_file()]
    missing = sorted({view.file for view in views} - {view.file for view in present})
    if not present:
        raise FileNotFoundError(f"{images}: expected the photos of the COLMAP model; found none of {len(views)}"
                                + (f" (looked for {missing[0]})" if missing else ""))
    if missing:
        warnings.warn(f"{images}: skipped {len(missing)} of {len(views)} photos of the COLMAP model, which do not exist "
                      f"(the first is {missing[0]})", stacklevel=4)
    return present, points


def _prepare(view: View, downscale: float) -> tuple[Photo, Tensor]:
    """The photo file to use, and the intrinsics `[3, 3]` of the image that comes of it."""
    path, small = view.photo(downscale)
    size = image_size(path)
    if not view.lens.fits(*size):
        raise ValueError(f"{path}: the photo is {size[0]}x{size[1]}; expected the {view.lens.width}x{view.lens.height} of its "
                         "camera, or the same shape at another scale")
    width, height = (max(1, round(side if small else side / downscale)) for side in size)
    lens = view.lens.resized(width, height)
    try:
        K = lens.undistorted().K
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return Photo(path, width, height, lens if lens.distorted else None, view.mask or _find_mask(view)), K


def _find_mask(view: View) -> Path | None:
    folder, file = view.folder, Path(view.file)
    candidates: Sequence[Path] = (
        folder.parent / "masks" / f"{file}.png",
        folder.parent / "masks" / file.with_suffix(".png"),
        folder / f"{file}.mask.png",
        folder / file.with_name(f"{file.stem}_mask.png"),
    )
    return next((candidate for candidate in candidates if candidate.is_file()), None)


def _depth_files(views: Sequence[View]) -> list[Path | None]:
    files = []
    for view in views:
        folder, file = view.folder.parent / "depths", Path(view.file)
        candidates = (folder / f"{file}.npy", folder / file.with_suffix(".npy"))
        found = next((candidate for candidate in candidates if candidate.is_file()), None)
        if found is not None and view.lens.distorted:
            raise ValueError(f"{found}: depth maps of distorted photos are not supported; undistort the photos first")
        files.append(found)
    return files if any(files) else []
