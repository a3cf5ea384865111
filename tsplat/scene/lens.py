"""`Lens`: the intrinsics of a photo as it was taken, and the way from a distorted photo to a pinhole one."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

MAX_ZOOM = 2.0              # of the undistorted photo against the distorted one
BORDER_SAMPLES = 65         # points looked at along each edge


@dataclass(frozen=True)
class Lens:
    """Intrinsics in pixels (the first pixel's centre is at 0.5, 0.5) and OpenCV distortion coefficients.

    Args:
        width, height: image size in pixels.
        fx, fy, cx, cy: focal lengths and principal point.
        distortion: `(k1, k2, p1, p2, k3, k4, k5, k6)`, or `(k1, k2, k3, k4)` of a fisheye; empty for none.
        fisheye: whether the radius on the image follows the angle (OpenCV's fisheye), not its tangent.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    fisheye: bool = False

    @staticmethod
    def of(width: int, height: int, params: Mapping[str, float], *, fisheye: bool = False) -> Lens:
        """From named parameters: fx, fy (or f), cx, cy, and any of k1 to k6, p1, p2."""
        names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
        distortion = tuple(float(params.get(name, 0.0)) for name in names)
        fx = params["fx"] if "fx" in params else params["f"]
        return Lens(width, height, float(fx), float(params.get("fy", fx)), float(params["cx"]), float(params["cy"]),
                    distortion if any(distortion) else (), fisheye)

    @property
    def distorted(self) -> bool:
        """Whether straight lines come out bent."""
        return self.fisheye or bool(self.distortion)

    @property
    def K(self) -> Tensor:
        """`[3, 3]` float32 intrinsics."""
        return torch.tensor([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=torch.float32)

    def resized(self, width: int, height: int) -> Lens:
        """The same lens for the whole photo at another size."""
        x, y = width / self.width, height / self.height
        return dataclasses.replace(self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x,
                                   cy=self.cy * y)

    def fits(self, width: int, height: int) -> bool:
        """Whether an image of this size can be the whole photo at another scale, up to rounding to whole pixels."""
        return abs(width * self.height - height * self.width) <= self.width + self.height

    def project(self, rays: Tensor) -> Tensor:
        """Pixels `[..., 2]` where the lens shows the points `[..., 2]` of the plane z = 1: OpenCV's models, as kornia has them."""
        from kornia.geometry.calibration import distort_points
        from kornia.geometry.camera.distortion_kannala_brandt import distort_points_kannala_brandt

        if self.fisheye:
            return distort_points_kannala_brandt(rays, rays.new_tensor([self.fx, self.fy, self.cx, self.cy, *(self.distortion or (0.0,) * 4)]))
        if self.distortion:
            rays = distort_points(rays, torch.eye(3).to(rays), rays.new_tensor(self.distortion))
        return rays * rays.new_tensor([self.fx, self.fy]) + rays.new_tensor([self.cx, self.cy])

    def undistorted(self) -> Lens:
        """The pinhole lens of the same size and principal point, zoomed in just so far that it sees nothing outside the photo.

        Raises:
            ValueError: no zoom up to `MAX_ZOOM` will do: the coefficients cannot be those of this photo.
        """
        pinhole = dataclasses.replace(self, distortion=(), fisheye=False)
        if not self.distorted or self._covers(pinhole):
            return pinhole
        low, high = 1.0, MAX_ZOOM
        if not self._covers(pinhole._zoomed(high)):
            raise ValueError(f"lens: the distortion {self.distortion} cannot be undone within a zoom of {MAX_ZOOM}; "
                             f"expected coefficients that fit {self.width}x{self.height} pixels and fx = {self.fx:.1f}")
        for _ in range(12):
            middle = (low + high) / 2
            low, high = (low, middle) if self._covers(pinhole._zoomed(middle)) else (middle, high)
        return pinhole._zoomed(high)

    def _zoomed(self, zoom: float) -> Lens:
        return dataclasses.replace(self, fx=self.fx * zoom, fy=self.fy * zoom)

    def _covers(self, pinhole: Lens) -> bool:
        """Whether every border point of the `pinhole` photo lies inside this one."""
        along = torch.linspace(0, 1, BORDER_SAMPLES, dtype=torch.float64)
        zero, one = torch.zeros_like(along), torch.ones_like(along)
        edges = [torch.stack(pair, dim=1) for pair in ((along, zero), (along, one), (zero, along), (one, along))]
        size = along.new_tensor([self.width, self.height])
        seen = self.project(_rays(pinhole, torch.cat(edges) * size))
        return bool(((seen >= -0.5) & (seen <= size + 0.5)).all())           # half a pixel is filled from the border


@lru_cache(maxsize=4)
def undistortion_grid(lens: Lens) -> Tensor:
    """`[1, H, W, 2]` float32: where in the distorted photo (-1 to 1) each pixel of `lens.undistorted()` is found."""
    y, x = torch.meshgrid(torch.arange(lens.height) + 0.5, torch.arange(lens.width) + 0.5, indexing="ij")
    pixels = lens.project(_rays(lens.undistorted(), torch.stack([x, y], dim=-1)))
    return (pixels / pixels.new_tensor([lens.width, lens.height]) * 2 - 1)[None]


def _rays(pinhole: Lens, pixels: Tensor) -> Tensor:
    centre, focal = pixels.new_tensor([pinhole.cx, pinhole.cy]), pixels.new_tensor([pinhole.fx, pinhole.fy])
    return (pixels - centre) / focal
