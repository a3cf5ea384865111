"""`ImageStore`: the photos of a capture, decoded when asked for and kept within a bound in bytes."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

from tsplat.scene.image_files import read_image
from tsplat.scene.lens import Lens, undistortion_grid

CACHE_BYTES = 2 << 30


@dataclass(frozen=True)
class Photo:
    """An image file and what is to come of it.

    Args:
        path: the image file.
        width, height: the size wanted, at most the file's.
        lens: how the photo of that size is distorted, or None if it is not.
        mask: an image that is black where the photo is to be left out and white elsewhere, of any size, or None.
    """

    path: Path
    width: int
    height: int
    lens: Lens | None = None
    mask: Path | None = None


class ImageStore:
    """`store[i]` is photo i as float32 `[H, W, 3]` in 0..1, or `[H, W, 4]` with the file's alpha or the mask.

    Colours are not multiplied by alpha. Images are reduced by averaging areas, undistorted, and kept as uint8; the ones
    used least recently are dropped, so that no more than `cache_bytes` bytes are held. Of several threads, one reads at a time.

    Raises:
        ValueError: from `store[i]`, naming the file, if it cannot be decoded.
    """

    def __init__(self, photos: Sequence[Photo], cache_bytes: int = CACHE_BYTES) -> None:
        if cache_bytes < 0:
            raise ValueError(f"cache_bytes: expected at least 0; got {cache_bytes}")
        self.photos = list(photos)
        self.cache_bytes = cache_bytes
        self._cache: OrderedDict[int, Tensor] = OrderedDict()
        self._held = 0
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self.photos)

    @property
    def held_bytes(self) -> int:
        """Bytes of the images now in the cache."""
        return self._held

    def __getitem__(self, index: int) -> Tensor:
        with self._lock:
            image = self._read(range(len(self.photos))[index])
        return image.to(torch.float32).div_(255)        # in place: a second tensor of this size took as long again (4K, whose pages are all new)

    def _read(self, index: int) -> Tensor:
        image = self._cache.get(index)
        if image is None:
            image = load_photo(self.photos[index])
            if image.nbytes <= self.cache_bytes:
                while self._held + image.nbytes > self.cache_bytes:
                    self._held -= self._cache.popitem(last=False)[1].nbytes
                self._cache[index] = image
                self._held += image.nbytes
        else:
            self._cache.move_to_end(index)
        return image


def load_photo(photo: Photo) -> Tensor:
    """Decode, reduce, undistort and mask a photo: `[H, W, 3 or 4]` uint8.

    Raises:
        ValueError: naming the file, if the photo or its mask cannot be decoded.
    """
    image = read_image(photo.path)
    if photo.lens is None and photo.mask is None and image.shape[:2] == (photo.height, photo.width):
        return image.contiguous()
    planes = _planes(image)
    if len(planes) == 4:
        planes[:3] *= planes[3:]                                       # averages of colours are weighted by alpha
    planes = _reshape(planes, photo)
    if len(planes) == 4:
        planes[:3] /= planes[3:].clamp(min=1 / 255)
    if photo.mask is not None:
        mask = _reshape(_planes(read_image(photo.mask)[..., :1]), photo)
        planes = torch.cat([planes[:3], mask * planes[3:] if len(planes) == 4 else mask])
    return (planes * 255).round().clamp(0, 255).to(torch.uint8).permute(1, 2, 0).contiguous()


def read_depth(path: Path, width: int, height: int) -> Tensor:
    """A depth map from a .npy file `[h, w]` of numbers, as float32 `[height, width]` nearest samples.

    Raises:
        ValueError: naming the file, if it is something else.
    """
    try:
        depth = np.load(path, allow_pickle=False)
    except (ValueError, EOFError) as error:
        raise ValueError(f"{path}: expected a .npy file of depths; {error}") from None
    if depth.ndim != 2 or depth.dtype.kind not in "fiu" or not depth.size:
        raise ValueError(f"{path}: expected depths [h, w]; got {depth.dtype} {list(depth.shape)}")
    depth = torch.from_numpy(depth.astype(np.float32))
    rows, columns = (((torch.arange(n) + 0.5) * (size / n)).long() for n, size in zip((height, width), depth.shape, strict=True))
    return depth[rows[:, None], columns]


def _planes(image: Tensor) -> Tensor:
    return image.permute(2, 0, 1).to(torch.float32) / 255              # [C, H, W] in 0..1


def _reshape(planes: Tensor, photo: Photo) -> Tensor:
    """Reduce to the size of `photo` and undistort: `[C, H, W]`."""
    if planes.shape[1:] != (photo.height, photo.width):
        planes = interpolate(planes[None], size=(photo.height, photo.width), mode="area")[0]
    if photo.lens is not None:
        grid = undistortion_grid(photo.lens)                           # [1, H, W, 2]
        planes = grid_sample(planes[None], grid, mode="bilinear", padding_mode="border", align_corners=False)[0]
    return planes
