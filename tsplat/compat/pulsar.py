"""The interface of Pulsar as PyTorch3D ships it (`pytorch3d.renderer.points.pulsar.Renderer`), on `tsplat.render_spheres`.

Images are those of the shipped program with an exact exponential. Where what it returns is not the gradient of the loss, the gradient is
returned here:

| | shipped (PyTorch3D 0.7.9) | here |
| --- | --- | --- |
| positions, radii, colours, opacities | mean over the pixels that track a sphere | sum over all pixels, the gradient |
| which hits have gradients | the `n_track` nearest of a pixel | all (`tracked_only=True`: the `n_track` nearest) |
| spheres below a few pixels | up to 1e4 times too large | the gradient |
| camera vector | times 1e-3 and areas; wrong for rotated orthographic cameras and with a principal point | the gradient |
| background, principal point, gamma | none | the gradient |
| ray through a centre, nothing hit | NaN | 0 for the position, and for the camera |
| opacities of a batch | those of its first item for all | each item's |
| principal point | cut to whole pixels | as given |
| `max_n_hits` | depends on what is loaded together | exactly the nearest so many |
| `exp` | approximate, 1.6e-2 off in the image | exact |
| dtype | float32 | float32, float64 |

Kept: the chord as the distance from the centre, the nearest depth f + 2e-6 where `min_depth` is 0, and that orthographic images are shifted
by half a pixel to the right, and down or, right-handed, up.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from tsplat.camera import Camera
from tsplat.checks import check_choice, check_size, check_tensor
from tsplat.spheres import BACKGROUND_DEPTH, SphereRendering, render_spheres

MAX_UINT = 2**32 - 1
"""No limit to `max_n_hits`."""
BEHIND_SENSOR = 2e-6
"""Hits count from this far behind the sensor where no `min_depth` is given."""
LENGTHS = (8, 10, 11, 13)
BATCH_RANKS = (3, 3, 2, 2, 2, 2)
"""Of the fields of `_Scene`."""
COUNTED_AT_FIRST = 8
"""Hits per pixel that `mode=1` looks for before it looks for twice as many."""


class Renderer(torch.nn.Module):
    """Renderer of spheres with Pulsar's interface.

    Args:
        width, height: image size in pixels.
        max_num_balls: no scene may have more spheres. (Nothing is allocated for them.)
        orthogonal_projection: orthographic rather than perspective.
        right_handed_system: the camera looks along its -z, rather than z; x is right and y up in both.
        background_normalized_depth: depth of the background in (0, 1), 1 being nearest.
        n_channels: numbers per sphere in `vert_col`.
        n_track: hits per pixel in the forward info.
        tracked_only: not in Pulsar: gradients only by way of the `n_track` nearest hits, as there.
    """

    device_tracker: Tensor

    def __init__(self, width: int, height: int, max_num_balls: int, orthogonal_projection: bool = False, right_handed_system: bool = False,
                 background_normalized_depth: float = BACKGROUND_DEPTH, n_channels: int = 3, n_track: int = 5, *, tracked_only: bool = False
                 ) -> None:
        super().__init__()
        for name, size in (("width", width), ("height", height), ("max_num_balls", max_num_balls), ("n_channels", n_channels),
                           ("n_track", n_track)):
            check_size(name, size)
        self.width, self.height, self.max_num_balls = width, height, max_num_balls
        self.orthogonal_projection, self.right_handed_system = orthogonal_projection, right_handed_system
        self.background_normalized_depth, self.n_channels, self.n_track = background_normalized_depth, n_channels, n_track
        self.tracked_only = tracked_only
        self.register_buffer("device_tracker", torch.zeros(1))          # in the state dicts of Pulsar's renderers

    def forward(self, vert_pos: Tensor, vert_col: Tensor, vert_rad: Tensor, cam_params: Tensor, gamma: float | Tensor, max_depth: float,
                min_depth: float = 0.0, bg_col: Tensor | None = None, opacity: Tensor | None = None, percent_allowed_difference: float = 0.01,
                max_n_hits: int = MAX_UINT, mode: int = 0, return_forward_info: bool = False, first_R_then_T: bool = False
                ) -> Tensor | tuple[Tensor, Tensor | None]:
        """Render, differentiably in everything up to `gamma`, `bg_col` and `opacity`.

        Args:
            vert_pos, vert_col, vert_rad: `[(B,) N, 3]`, `[(B,) N, n_channels]` and `[(B,) N]`: centres, features and radii.
            cam_params: `[(B,) 8]`, 10, 11 or 13 numbers: position (3), camera-to-world rotation (3: axis-angle; or 6: the first two rows,
                orthonormalised), focal length, sensor width, and the offset of the principal point (none, or 2) to the left and up in pixels.
            gamma: in [1e-5, 1], from hard to transparent spheres.
            max_depth, min_depth: hits beyond or before do not count; min_depth 0: from just behind the sensor.
            bg_col: `[n_channels]` or `[B, n_channels]`, default ones.
            opacity: `[(B,) N]`, default ones.
            percent_allowed_difference: a part of 1: what of the weights may be left out.
            max_n_hits: only so many nearest hits of a ray count.
            mode: 0 for the image, 1 for the number of hits of each pixel.
            return_forward_info: also return `[(B,) H, W, 3 + 2 n_track]`: largest exponent, denominator relative to its exponential, the
                largest distance of the nearest points of the spheres hit (each of background and tracked hits); and of the n_track nearest
                hits each the id (the bits of an integer: see `sphere_ids_from_result_info_nograd`) and the depth, both -1 where there is
                none. No gradients. None with mode 1.
            first_R_then_T: the position is given in camera axes.

        Returns:
            `[(B,) H, W, n_channels]`, with mode 1 `[(B,) H, W, 1]`; with `return_forward_info`, that and the info. There is a B if any
            argument has one.

        Raises:
            ValueError, TypeError: naming the argument, what came and what is expected.
        """
        check_choice("mode", mode, (0, 1))
        check_size("max_n_hits", max_n_hits)
        check_tensor("cam_params", cam_params, ("B", "P") if getattr(cam_params, "ndim", 1) > 1 else ("P",))
        if cam_params.shape[-1] not in LENGTHS:
            raise ValueError(f"cam_params: expected 8, 10, 11 or 13 numbers per camera; got shape {list(cam_params.shape)}")
        check_tensor("vert_pos", vert_pos, (..., "N", 3))
        N = vert_pos.shape[-2]
        check_tensor("vert_col", vert_col, (..., N, self.n_channels))
        check_tensor("vert_rad", vert_rad, (..., N))
        if opacity is not None:
            check_tensor("opacity", opacity, (..., N))
        if N > self.max_num_balls:
            raise ValueError(f"vert_pos: expected at most max_num_balls = {self.max_num_balls} spheres; got {N}")
        scene = _Scene(vert_pos, vert_col, vert_rad, opacity, bg_col, cam_params)
        batches = scene.batches()
        if len(batches) > 1:
            raise ValueError(f"vert_pos, vert_col, vert_rad, cam_params, bg_col, opacity: expected batches of one size; got {sorted(batches)}")
        scene = scene._replace(cam_params=cam_params.expand(*batches or (1,), -1))
        near = [float(min_depth) or f + BEHIND_SENSOR for f in scene.cam_params[:, 6 if scene.axis_angle else 9].tolist()]
        parts = [(scene, near[0])] if len(set(near)) == 1 else [(scene.item(i), n) for i, n in enumerate(near)]      # the core has one near
        results = [self._render(part, gamma, n, float(max_depth), percent_allowed_difference, max_n_hits, mode,
                                return_forward_info and mode == 0, first_R_then_T) for part, n in parts]
        images, infos = zip(*results, strict=True)
        image = torch.cat(images) if batches else images[0].squeeze(0)
        if not return_forward_info:
            return image
        return image, None if mode else torch.cat(infos) if batches else infos[0].squeeze(0)

    def extra_repr(self) -> str:
        """For `print`."""
        return f"width={self.width}, height={self.height}, max_num_balls={self.max_num_balls}"

    @staticmethod
    def sphere_ids_from_result_info_nograd(result_info: Tensor) -> Tensor:
        """Ids int32 `[B, H, W, n_track]` in the forward info `[(B,) H, W, 3 + 2 n_track]`, -1 where there is no hit (B = 1 without)."""
        info = result_info if result_info.ndim == 4 else result_info[None]
        return info[..., 3::2].contiguous().view(_integers(info.dtype)).to(torch.int32)

    @staticmethod
    def depth_map_from_result_info_nograd(result_info: Tensor) -> Tensor:
        """Depth `[(B,) H, W]` of the nearest hit in the forward info, -1 where there is none."""
        return result_info[..., 4]

    def _render(self, scene: _Scene, gamma: float | Tensor, near: float, far: float, tolerance: float, max_n_hits: int, mode: int,
                with_info: bool, first_R_then_T: bool) -> tuple[Tensor, Tensor | None]:
        """Image (or hit map) and info, of a batch."""
        positions, colors, radii, opacities, background, _ = scene
        camera = self._camera(scene, first_R_then_T)
        gamma = gamma.reshape(()) if isinstance(gamma, Tensor) else gamma

        def render(n_track: int) -> SphereRendering:
            return render_spheres(positions, colors, radii, camera, opacities=opacities, background=background, gamma=gamma, near=near,
                                  far=far, background_depth=self.background_normalized_depth, distance="chord", n_track=n_track,
                                  tracked_only=self.tracked_only and n_track > 0, percent_allowed_difference=tolerance)

        if mode == 1:
            with torch.no_grad():
                count = COUNTED_AT_FIRST
                while True:
                    hits = render(count).hits
                    assert hits is not None
                    found = (hits.ids >= 0).sum(-1, keepdim=True)
                    if count >= max_n_hits or int(found.max()) < count:
                        return found.clamp_max(max_n_hits).to(positions.dtype), None
                    count *= 2
        limited = max_n_hits < positions.shape[-2]
        rendering = render(max(self.n_track, max_n_hits) if limited else self.n_track if with_info or self.tracked_only else 0)
        image = _nearest_only(rendering, colors, background, max_n_hits) if limited else rendering.image
        with torch.no_grad():
            return image, self._info(rendering, scene, camera, gamma, near, far) if with_info else None

    def _camera(self, scene: _Scene, first_R_then_T: bool) -> Camera:
        """The camera vectors.

        In camera axes a point is diag(1, -1, +-1) R^T (p - t): y is up there, and down in ours.
        """
        end = 6 if scene.axis_angle else 9
        position, turn, rest = scene.cam_params[:, :3], scene.cam_params[:, 3:end], scene.cam_params[:, end:]
        R = _rotation_of_axis_angle(turn) if scene.axis_angle else _rotation_of_rows(turn)
        if first_R_then_T:
            position = (R * position[:, None]).sum(-1)
        focal, sensor = rest[:, 0], rest[:, 1]
        offset = rest[:, 2:] if rest.shape[1] == 4 else rest.new_zeros(len(rest), 2)
        axes = R.mT * R.new_tensor([1.0, -1.0, -1.0 if self.right_handed_system else 1.0])[:, None]
        translation = -(axes * position[:, None]).sum(-1, keepdim=True)                 # not a product: it might be rounded to TF32
        bottom = R.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(R), 1, 4)
        viewmats = torch.cat([torch.cat([axes, translation], 2), bottom], 1)

        right, down = (0.5, -0.5 if self.right_handed_system else 0.5) if self.orthogonal_projection else (0.0, 0.0)
        f = self.width / sensor * (1.0 if self.orthogonal_projection else focal)
        cx, cy = self.width / 2 + right - offset[:, 0], self.height / 2 + down - offset[:, 1]
        zero, one = torch.zeros_like(f), torch.ones_like(f)
        Ks = torch.stack([f, zero, cx, zero, f, cy, zero, zero, one], -1).view(-1, 3, 3)
        return Camera(viewmats, Ks, self.width, self.height, model="orthographic" if self.orthogonal_projection else "pinhole")

    def _info(self, rendering: SphereRendering, scene: _Scene, camera: Camera, gamma: float | Tensor, near: float, far: float) -> Tensor:
        assert rendering.hits is not None
        ids, depths = (v[..., :self.n_track] for v in rendering.hits[:2])
        hit = ids >= 0

        def take(values: Tensor) -> Tensor:
            """Of `[(B,) N]`, those of the hits `[B, H, W, n]`; N may be 0."""
            return torch.nn.functional.pad(values, (0, 1)).expand(len(ids), -1).gather(1, ids.clamp_min(0).long().flatten(1)).view(ids.shape)

        exponents = (1 - (depths - near) / (far - near)) / gamma
        exponents = exponents if scene.opacities is None else take(scene.opacities) * exponents
        background = self.background_normalized_depth / gamma
        largest = torch.where(hit, exponents, -torch.inf).amax(-1).clamp_min(background)
        offsets = (camera.viewmats[:, None, :3, :3] * scene.positions[..., None, :]).sum(-1) + camera.viewmats[:, None, :3, 3]
        distances = offsets[..., 2] if self.orthogonal_projection else torch.linalg.vector_norm(offsets, dim=-1)
        farthest = torch.where(hit, take(distances - scene.radii), -1.0).amax(-1)
        bits = ids.to(_integers(depths.dtype)).view(depths.dtype)
        pairs = torch.stack([bits, torch.where(hit, depths, -1.0)], -1).flatten(-2)
        return torch.cat([torch.stack([largest, (rendering.logsumexp - largest).exp(), farthest], -1), pairs], -1)


class _Scene(NamedTuple):
    """What a batch may have one of for each item."""

    positions: Tensor
    colors: Tensor
    radii: Tensor
    opacities: Tensor | None
    background: Tensor | None
    cam_params: Tensor

    @property
    def axis_angle(self) -> bool:
        return self.cam_params.shape[-1] in (8, 10)

    def batches(self) -> set[int]:
        """The sizes of those that are batches."""
        return {len(v) for v, rank in zip(self, BATCH_RANKS, strict=True) if v is not None and v.ndim == rank}

    def item(self, i: int) -> _Scene:
        """Item i, as a batch of 1."""
        return _Scene(*(v[i:i + 1] if v is not None and v.ndim == rank else v  # type: ignore[arg-type]
                        for v, rank in zip(self, BATCH_RANKS, strict=True)))


def _nearest_only(rendering: SphereRendering, colors: Tensor, background: Tensor | None, count: int) -> Tensor:
    """The image of only the `count` nearest hits of each ray: their weights, in proportion."""
    assert rendering.hits is not None
    ids, weights = rendering.hits.ids[..., :count], rendering.hits.weights[..., :count, None]
    B, D = len(ids), colors.shape[-1]
    index = ids.clamp_min(0).long().view(B, -1, 1).expand(-1, -1, D)
    features = colors.expand(B, -1, D).gather(1, index).view(*ids.shape, D)
    rest = 1 - rendering.alpha[..., None]
    behind = rest if background is None else rest * background.expand(B, D)[:, None, None]
    return ((weights * features).sum(-2) + behind) / (weights.sum(-2) + rest)


def _rotation_of_axis_angle(turn: Tensor) -> Tensor:
    """`[B, 3, 3]` of `[B, 3]`, by the exponential of the cross product matrix, which is smooth at 0."""
    x, y, z = turn.unbind(-1)
    zero = torch.zeros_like(x)
    R: Tensor = torch.linalg.matrix_exp(torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).view(-1, 3, 3))
    return R


def _rotation_of_rows(rows: Tensor) -> Tensor:
    """`[B, 3, 3]` of the first two rows `[B, 6]` (Zhou et al. 2019, On the Continuity of Rotation Representations, equation 11)."""
    a, b = rows[:, :3], rows[:, 3:]
    x = torch.nn.functional.normalize(a, dim=-1)
    y = torch.nn.functional.normalize(b - (x * b).sum(-1, keepdim=True) * x, dim=-1)
    return torch.stack([x, y, torch.linalg.cross(x, y)], 1)


def _integers(dtype: torch.dtype) -> torch.dtype:
    """Integers as wide as these floating-point numbers."""
    return torch.int64 if dtype == torch.float64 else torch.int32
