"""`Camera`: where the pictures are taken from, as one object that every call takes."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from tsplat.checks import check_number, check_size, check_tensor

CameraModel = Literal["pinhole", "orthographic", "fisheye"]
MODELS: tuple[CameraModel, ...] = ("pinhole", "orthographic", "fisheye")
NO_SKEW = 1e-5
"""What may be off in the entries of Ks that are not used, as if by rounding: a part of fx or fy, 0.01 pixel at 1000 from the centre."""
PARALLEL = 1e-6
"""Least angle in radians between the view and `up`."""

# private; should a release of torch be without it, vmap has an error of its own
_is_mapped: Callable[[Tensor], bool] = getattr(torch._C._functorch, "is_batchedtensor", lambda _: False)


@dataclass(frozen=True)
class Camera:
    """One camera or a batch of C cameras of the same image size.

    Axes are OpenCV's: x right, y down, z forward; pixel (column j, row i) has its centre at (j + 0.5, i + 0.5).

    Args:
        viewmats: `[C, 4, 4]` or `[4, 4]`, world to camera.
        Ks: `[C, 3, 3]` or `[3, 3]`, intrinsics in pixels: `[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]`. For the orthographic
            model fx and fy are pixels per world unit; for the (equidistant) fisheye, pixels per radian.
        width, height: image size in pixels, at least 1.
        model: `"pinhole"`, `"orthographic"` or `"fisheye"`.
        near, far: splats whose depth (camera z) is outside `(near, far)` are culled.

    Raises:
        ValueError, TypeError: naming the argument, what came and what is expected. What the matrices hold is not checked on a GPU, for
            which Python would have to wait, or while compiling; otherwise, they must be finite, and Ks of the form above: skew is not
            supported (not checked if Ks requires grad, where finite differences or an optimiser may move entries that are not used).
    """

    viewmats: Tensor
    Ks: Tensor
    width: int
    height: int
    model: CameraModel = "pinhole"
    near: float = 0.01
    far: float = 1e10

    def __post_init__(self) -> None:
        check_size("width", self.width)
        check_size("height", self.height)
        if self.model not in MODELS:
            raise ValueError(f"camera.model: expected one of {', '.join(MODELS)}; got {self.model!r}")
        check_number("camera.near", self.near, "a depth below camera.far")
        check_number("camera.far", self.far, "a depth above camera.near")
        if not self.near < self.far:
            raise ValueError(f"camera.near, camera.far: expected near < far; got {self.near} and {self.far}")
        check_tensor("camera.viewmats", self.viewmats, (..., 4, 4))
        check_tensor("camera.Ks", self.Ks, (..., 3, 3), like=self.viewmats)
        if self.viewmats.ndim not in (2, 3) or self.viewmats.shape[:-2] != self.Ks.shape[:-2]:
            raise ValueError("camera.viewmats, camera.Ks: expected [C, 4, 4] and [C, 3, 3], or [4, 4] and [3, 3]; "
                             f"got {list(self.viewmats.shape)} and {list(self.Ks.shape)}")
        if not torch.compiler.is_compiling() and (_is_mapped(self.viewmats) or _is_mapped(self.Ks)):
            raise NotImplementedError("camera: a Camera cannot be made under torch.func.vmap; give the viewmats [C, 4, 4] and Ks [C, 3, 3] of all "
                                      "cameras in one call, which is faster, too")
        if self.viewmats.device.type == "cpu" and not torch.compiler.is_compiling():
            for name, matrices in (("camera.viewmats", self.viewmats), ("camera.Ks", self.Ks)):
                if not bool(matrices.isfinite().all()):
                    raise ValueError(f"{name}: expected finite numbers; got NaN or infinity in {matrices.tolist()}")
            if not self.Ks.requires_grad and not all(map(_has_form, self.Ks.reshape(-1, 3, 3).tolist())):
                raise ValueError("camera.Ks: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], as skew and other homographies are not "
                                 f"supported; got {self.Ks.tolist()}")

    @property
    def batched(self) -> bool:
        """Whether there is a leading camera dimension (and so one on every image)."""
        return self.viewmats.ndim == 3

    def __len__(self) -> int:
        return self.viewmats.shape[0] if self.batched else 1

    def __getitem__(self, index: int | slice | Tensor) -> Camera:
        if not self.batched:
            raise TypeError("camera: a single camera cannot be indexed; give viewmats of shape [C, 4, 4]")
        return dataclasses.replace(self, viewmats=self.viewmats[index], Ks=self.Ks[index])

    def to(self, *args: object, **kwargs: object) -> Camera:
        """As `torch.Tensor.to`, for the two matrices."""
        return dataclasses.replace(self, viewmats=self.viewmats.to(*args, **kwargs), Ks=self.Ks.to(*args, **kwargs))  # type: ignore[call-overload]

    def resized(self, width: int, height: int) -> Camera:
        """The same view in pictures of another size: the intrinsics are scaled, along both axes by themselves."""
        scale = self.Ks.new_tensor([[width / self.width], [height / self.height], [1.0]])
        return dataclasses.replace(self, Ks=self.Ks * scale, width=width, height=height)

    @staticmethod
    def look_at(eye: Sequence[float] | Tensor, target: Sequence[float] | Tensor, up: Sequence[float] | Tensor = (0.0, -1.0, 0.0), *,
                width: int, height: int, fov: float = 50.0, dtype: torch.dtype = torch.float32) -> Camera:
        """A pinhole camera at `eye` that looks at `target`.

        Args:
            eye, target: `[3]` world points, not equal.
            up: `[3]` world direction that is up in the image, not along the view. The default suits captures with y down.
            width, height: image size in pixels.
            fov: horizontal field of view in degrees.

        Raises:
            ValueError: if eye and target are equal, or up is along the view or zero (not checked while compiling).
        """
        eye, target, up = (torch.as_tensor(v, dtype=torch.float64) for v in (eye, target, up))
        forward = torch.nn.functional.normalize(target - eye, dim=0)
        sideways = torch.linalg.cross(forward, torch.nn.functional.normalize(up, dim=0))
        if not torch.compiler.is_compiling() and not bool(torch.linalg.vector_norm(sideways) > PARALLEL):
            if not bool(torch.linalg.vector_norm(forward) > 0):
                raise ValueError(f"eye, target: expected two points; got {eye.tolist()} and {target.tolist()}")
            raise ValueError(f"up: expected a direction that is not along the view, {forward.tolist()}; got {up.tolist()}")
        right = torch.nn.functional.normalize(sideways, dim=0)
        rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])      # rows: x right, y down, z forward
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ eye
        f = 0.5 * width / math.tan(math.radians(fov) / 2)
        K = torch.tensor([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]], dtype=torch.float64)
        return Camera(viewmat.to(dtype), K.to(dtype), width, height)


def _has_form(K: list[list[float]]) -> bool:
    """Whether K is [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]."""
    (fx, skew, _), (shear, fy, _), (px, py, one) = K
    off = skew / fx if fx else skew, shear / fy if fy else shear, px, py, one - 1
    return max(map(abs, off)) <= NO_SKEW
