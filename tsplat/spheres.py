"""`render_spheres`: spheres and a camera to an image, in one differentiable call (Pulsar)."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import torch
from torch import Tensor
from tsplat_reference import hit_weights

from tsplat import ops
from tsplat.camera import Camera
from tsplat.checks import NUMBERS, check_choice, check_flag, check_number, check_size, check_tensor
from tsplat.rasterize import TILE, DepthMode

Distance = Literal["orthogonal", "chord"]
GAMMA = 1e-5, 1.0
"""Range of gamma (Pulsar, section 3.2)."""
BACKGROUND_DEPTH = 1e-6
TOLERANCE = 1e-4


class Hits(NamedTuple):
    """The n nearest hits of each pixel, front to back.

    ids: int32 `[(C,) H, W, n]`, index of the sphere, or -1 where there are fewer hits.
    depths: distance along the ray; infinite where there is no hit. weights: in the image. Both are differentiable.
    """

    ids: Tensor
    depths: Tensor
    weights: Tensor


class SphereRendering(NamedTuple):
    """Result of `render_spheres`, with a leading dimension C where the camera is a batch.

    image: `[(C,) H, W, D]`. alpha: `[(C,) H, W]`, 1 minus the background's weight. depth: `[(C,) H, W]` or None. hits: or None.
    visible: bool `[(C,) N]`, which spheres were not culled. logsumexp: `[(C,) H, W]`, log of the denominator of the weights, part of the
    graph. needed: int64 `[]`, the capacity that was needed, if one was given: if it is more than that, spheres are missing in the image.
    """

    image: Tensor
    alpha: Tensor
    depth: Tensor | None
    hits: Hits | None
    visible: Tensor
    logsumexp: Tensor
    needed: Tensor | None


def render_spheres(positions: Tensor, features: Tensor, radii: Tensor, camera: Camera, *, opacities: Tensor | None = None,
                   background: Tensor | None = None, gamma: float | Tensor, near: float, far: float,
                   background_depth: float = BACKGROUND_DEPTH, distance: Distance = "orthogonal", depth: DepthMode | None = None,
                   n_track: int = 0, tracked_only: bool = False, percent_allowed_difference: float = TOLERANCE, fade_below: float = 0.0,
                   tile: int = TILE, capacity: int | None = None) -> SphereRendering:
    """Render N spheres (Pulsar, section 3.2, equation 1).

    Along a pixel's ray, sphere i weighs o_i d_i exp(o_i z_i / gamma) over the sum of that over all spheres and exp(background_depth / gamma)
    for the background. D_i is the distance at which the ray enters the sphere, z_i = 1 - (D_i - near)/(far - near), and d_i falls
    linearly from 1 for a ray through the centre to 0 at the outline.

    Differentiable, twice, in positions, features, radii, opacities, background, gamma and the camera's matrices. Spheres that are not finite
    or whose radius is not positive are left out and get zero gradient.

    Args:
        positions: `[N, 3]`, or `[C, N, 3]`: a geometry for each camera. So are the following three.
        features: `[N, D]` or `[C, N, D]`: colours, or any D numbers from 1 to blend.
        radii: `[N]` or `[C, N]`, in world units.
        camera: one or a batch of C cameras, pinhole or orthographic. Its near and far, camera z's of Gaussians, are not used.
        opacities: `[N]` or `[C, N]`, in [0, 1], default ones.
        background: `[D]` or `[C, D]`, default ones.
        gamma: in [1e-5, 1], a number or a tensor `[]`: small for hard, opaque spheres, large for transparent ones.
        near, far: hits with D outside [near, far] do not count. near >= 0 for a pinhole camera.
        background_depth: z of the background, in (0, 1).
        distance: of ray and centre in d: `"orthogonal"`, from the ray (the paper), or `"chord"`, from its point at the centre's distance from
            the camera (the authors' program).
        depth: also render D: `"accumulated"`, sum of weight times D, or `"expected"`, that divided by alpha.
        n_track: also return the ids, depths and weights of this many nearest hits of each pixel.
        tracked_only: gradients of geometry and features only by way of these n_track hits (as in the paper), rather than of all.
        percent_allowed_difference: a part of 1 (as in the authors' program, in spite of the name). A tile ends where all that is behind,
            together, weighs at most this at each of its pixels; 0 for no end.
        fade_below: the gradients of positions and radii (not that of the camera) fade out smoothly for spheres whose projected radius
            is below this many pixels, as they are noise there (Pulsar, section 6); 0 for never.
        tile: pixels along the side of a tile; never visible in the result. 8, the default, is the only one on a GPU.
        capacity: room for this many hits of spheres and tiles; as in `rasterize`.

    Raises:
        ValueError, TypeError: naming the argument, what came and what is expected.
        NotImplementedError: for fisheye cameras, on a GPU where Triton is not installed, and for forward-mode derivatives.
    """
    opacities = positions.new_ones(radii.shape) if opacities is None and isinstance(radii, Tensor) else opacities
    _check(positions, features, radii, camera, opacities, background, gamma, near, far, background_depth, distance, depth, n_track,
           tracked_only, percent_allowed_difference, fade_below, tile, capacity)
    C, width, height, model, chord = len(camera), camera.width, camera.height, camera.model, distance == "chord"
    viewmats, Ks = (camera.viewmats, camera.Ks) if camera.batched else (camera.viewmats[None], camera.Ks[None])
    p, f, R, o = (v if v.ndim == rank else v[None] for v, rank in ((positions, 3), (features, 3), (radii, 2), (opacities, 2)))
    g = gamma.to(positions) if isinstance(gamma, Tensor) else positions.new_full((), gamma)
    backgrounds = positions.new_ones(C, f.shape[-1]) if background is None else background.expand(C, -1)

    # 0 for a NaN, of which the gradient by the camera's pose would be one, too
    known = torch.linalg.vector_norm(p.detach(), 2, -1) < torch.inf
    p = torch.where(known[..., None], p, 0.0)
    if fade_below > 0:
        keep = _fading(p.detach(), R.detach(), viewmats.detach(), Ks.detach(), model, fade_below)
        p, R = _scale_gradient(p.expand(C, -1, 3), keep[..., None]), _scale_gradient(R.expand(C, -1), keep)
    centers = _to_camera(p, viewmats)
    outline = ops.outlines(centers, R, Ks, width, height, model, near, far)
    finite = known & (torch.linalg.vector_norm(f.detach(), 2, -1) < torch.inf) & (o.detach() >= 0) & (o.detach() < torch.inf)
    visible = outline.radii * finite[..., None]
    to_bin = outline.means2d, visible, outline.conics, outline.opacities, outline.depths, width, height, tile
    bins, needed = (ops.bin_splats(*to_bin), None) if capacity is None else ops.bin_splats_fixed(*to_bin, capacity)

    ids = cutoff = None
    if n_track:
        ids = ops.nearest_hits(centers, R, Ks, *bins, n_track + tracked_only, width, height, tile, model, near, far, chord)
        if tracked_only:                                # half way to the next hit: D of a grazing ray, computed twice, is not quite the same
            last, _ = hit_weights(centers.detach(), R.detach(), o.detach(), g.detach(), Ks.detach(), centers.new_zeros(C, height, width),
                                  ids[..., -2:], model, near, far, background_depth, chord)
            cutoff, ids = last.mean(-1), ids[..., :-1].contiguous()
    images = ops.blend_spheres(centers, R, o, f, backgrounds, g, Ks, *bins, cutoff, width, height, tile, model, near, far, background_depth,
                               chord, depth is not None, percent_allowed_difference)
    alpha = -torch.expm1(-images.logsumexp)
    logsumexp = images.logsumexp + background_depth / g
    z = None
    if depth is not None:
        z = images.depth / alpha.clamp_min(1e-10) if depth == "expected" else images.depth
    hits = None
    if ids is not None:
        hits = Hits(ids, *hit_weights(centers, R, o, g, Ks, images.logsumexp, ids, model, near, far, background_depth, chord))
    seen = visible[..., 0] > 0
    if camera.batched:
        return SphereRendering(images.image, alpha, z, hits, seen, logsumexp, needed)
    return SphereRendering(images.image.squeeze(0), alpha.squeeze(0), None if z is None else z.squeeze(0),
                           None if hits is None else Hits(*(h.squeeze(0) for h in hits)), seen.squeeze(0), logsumexp.squeeze(0), needed)


def _to_camera(positions: Tensor, viewmats: Tensor) -> Tensor:
    """World to camera space `[C, N, 3]`, by columns: a matrix product might be rounded to TF32."""
    x, y, z = (v[..., None] for v in positions.unbind(-1))
    columns = viewmats[:, None, :3].unbind(-1)
    return torch.addcmul(torch.addcmul(torch.addcmul(columns[3], x, columns[0]), y, columns[1]), z, columns[2])


def _fading(positions: Tensor, radii: Tensor, viewmats: Tensor, Ks: Tensor, model: str, below: float) -> Tensor:
    """What part of their gradient small spheres keep, `[C, N]`: a smooth step (3 t^2 - 2 t^3) of the projected radius."""
    pixels = radii * (Ks[:, 0, 0] * Ks[:, 1, 1]).sqrt()[:, None]
    if model == "pinhole":
        pixels = pixels / torch.linalg.vector_norm(_to_camera(positions, viewmats), dim=-1)
    t = (pixels / below).clamp(0, 1).nan_to_num(0.0)
    return t * t * (3 - 2 * t)


def _scale_gradient(value: Tensor, factor: Tensor) -> Tensor:
    """The value, whose gradient is scaled."""
    return value.detach() + (value - value.detach()) * factor


def _check(positions: Tensor, features: Tensor, radii: Tensor, camera: Camera, opacities: Tensor | None, background: Tensor | None,
           gamma: float | Tensor, near: float, far: float, background_depth: float, distance: str, depth: str | None, n_track: int,
           tracked_only: bool, tolerance: float, fade_below: float, tile: int, capacity: int | None) -> None:
    """Errors that name the argument, what came and what is expected."""
    if not isinstance(camera, Camera):
        raise TypeError(f"camera: expected a tsplat.Camera; got {type(camera).__name__}")
    if camera.model == "fisheye":
        raise NotImplementedError("camera.model: render_spheres has pinhole and orthographic cameras; got 'fisheye'")
    C = len(camera)
    if not C:
        raise ValueError("camera: expected at least 1 camera; got a batch of 0")
    check_tensor("positions", positions, ("N", 3) if getattr(positions, "ndim", 2) < 3 else (C, "N", 3))
    if positions.dtype not in (torch.float32, torch.float64):
        raise TypeError("positions: expected dtype torch.float32 or torch.float64, as half precision cannot hold a position; "
                        f"got {positions.dtype}")
    N = positions.shape[-2]
    for name, value, rest in (("features", features, ("D",)), ("radii", radii, ()), ("opacities", opacities, ())):
        check_tensor(name, value, (N, *rest) if getattr(value, "ndim", 0) < 2 + len(rest) else (C, N, *rest), like=positions)
    if not features.shape[-1]:
        raise ValueError(f"features: expected at least 1 channel; got shape {list(features.shape)}")
    if background is not None:
        D = features.shape[-1]
        check_tensor("background", background, (D,) if getattr(background, "ndim", 1) < 2 else (C, D), like=positions)
    check_tensor("camera.viewmats", camera.viewmats, (..., 4, 4), like=positions)
    if isinstance(gamma, Tensor):
        check_tensor("gamma", gamma, ())
    else:
        check_number("gamma", gamma, "a number in [1e-5, 1]")
    if (isinstance(gamma, NUMBERS) or (gamma.is_cpu and not torch.compiler.is_compiling())) and not GAMMA[0] <= gamma <= GAMMA[1]:
        raise ValueError(f"gamma: expected a number in [1e-5, 1]; got {float(gamma)}")
    for name, number in (("near", near), ("far", far)):
        check_number(name, number, "a distance along the ray")
    if not -math.inf < near < far < math.inf:
        raise ValueError(f"near, far: expected near < far, both finite; got {near} and {far}")
    if camera.model == "pinhole" and near < 0:
        raise ValueError(f"near: expected a distance of at least 0 for a pinhole camera; got {near}")
    check_number("background_depth", background_depth, "a number in (0, 1)")
    if not 0 < background_depth < 1:
        raise ValueError(f"background_depth: expected a number in (0, 1); got {background_depth}")
    check_choice("distance", distance, ("orthogonal", "chord"))
    if depth is not None:
        check_choice("depth", depth, ("accumulated", "expected"))
    if n_track:
        check_size("n_track", n_track)
    check_flag("tracked_only", tracked_only)
    if tracked_only and not n_track:
        raise ValueError("tracked_only: expected n_track of at least 1 with it; got n_track = 0")
    check_number("percent_allowed_difference", tolerance, "a number in [0, 1)")
    if not 0 <= tolerance < 1:
        raise ValueError(f"percent_allowed_difference: expected a number in [0, 1), a part of 1; got {tolerance}")
    check_number("fade_below", fade_below, "a radius in pixels, 0 for none")
    if not 0 <= fade_below < math.inf:
        raise ValueError(f"fade_below: expected a radius in pixels of at least 0; got {fade_below}")
    check_size("tile", tile)
    if capacity is not None:
        check_size("capacity", capacity)
