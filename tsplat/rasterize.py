"""`rasterize`: Gaussians and a camera to an image, in one differentiable call."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, NamedTuple

import torch
from torch import Tensor
from tsplat_reference import camera_centers, tile_counts
from tsplat_reference.constants import ALPHA_MAX, EPS2D

from tsplat import ops
from tsplat.camera import MODELS, Camera
from tsplat.checks import check_choice, check_flag, check_number, check_size, check_tensor
from tsplat.drawn import Drawn, is_finite, shade

if TYPE_CHECKING:
    from torch.distributed import ProcessGroup  # some builds of torch have none

TILE = 8
"""Pixels along the side of a tile. On a CPU 8 beats 4, 6 and 16: smaller tiles have more hits to sort, larger ones more idle pairs."""
MAX_DEGREE = 4

DepthMode = Literal["accumulated", "expected"]


class Meta(NamedTuple):
    """What happened on the way, for C cameras and N Gaussians.

    Of a call with a `group`, C are the cameras of all W ranks, those of rank 0 first, and N the own Gaussians; but `offsets` and `hits` are of
    the own cameras. Then `radii`, `means2d` and `depths` have a row for each pair that was drawn, `[V, ...]`, in the order of `visible_ids`, as
    there are too many of the others to hold.

    radii: int32 `[C, N, 2]`, half size in pixels of the box that a splat can touch; 0 if it is culled.
    means2d: `[C, N, 2]` in pixels; part of the graph (`meta.means2d.retain_grad()`).
    depths: `[C, N]`, camera z.
    offsets: int64 `[C tiles_y tiles_x + 1]`, where each tile's list of splats begins. tiles: (tiles_y, tiles_x).
    needed: int64 `[]`, the capacity that was needed, if one was given: if it is more than that, splats are missing in the image.
    pairs: int64 `[V, 2]`, of a call with a group: camera and Gaussian of each row. shape: then (C, N).
    """

    radii: Tensor
    means2d: Tensor
    depths: Tensor
    offsets: Tensor
    tiles: tuple[int, int]
    needed: Tensor | None = None
    pairs: Tensor | None = None
    shape: tuple[int, int] = (0, 0)

    @property
    def hits(self) -> Tensor:
        """Int64 `[C, tiles_y, tiles_x]`: splats per tile."""
        return self.offsets.diff().view(-1, *self.tiles)

    @property
    def visible(self) -> Tensor:
        """Bool `[C, N]`: which splats were drawn."""
        if self.pairs is None:
            return (self.radii > 0).all(-1)
        where = self.pairs[:, 0] * self.shape[1] + self.pairs[:, 1]
        return self.pairs.new_zeros(self.shape, dtype=torch.bool).flatten().index_fill_(0, where, True).view(self.shape)

    @property
    def visible_ids(self) -> Tensor:
        """Int64 `[V, 2]`: camera and Gaussian of the splats that were drawn, camera by camera."""
        return self.visible.nonzero() if self.pairs is None else self.pairs

    @property
    def views(self) -> Tensor:
        """Int64 `[N]`: how many of the cameras drew each splat."""
        if self.pairs is None:
            return self.visible.sum(0)
        return self.pairs.new_zeros(self.shape[1]).index_add_(0, self.pairs[:, 1], torch.ones_like(self.pairs[:, 1]))


class Rendering(NamedTuple):
    """Result of `rasterize`, with a leading dimension C where the camera is a batch.

    image: `[(C,) H, W, D]`. alpha: `[(C,) H, W]`, 1 minus the background's weight. depth: `[(C,) H, W]` or None.
    """

    image: Tensor
    alpha: Tensor
    depth: Tensor | None
    meta: Meta


def rasterize(means: Tensor, quats: Tensor | None, scales: Tensor | None, opacities: Tensor, colors: Tensor, camera: Camera, *,
              sh_degree: int | None = None, covars: Tensor | None = None, background: Tensor | None = None,
              depth: DepthMode | None = None, antialiased: bool = False, eps2d: float = EPS2D, alpha_max: float = ALPHA_MAX, drop_last: bool = False,
              screen_offset: Tensor | None = None, absgrad: Tensor | None = None, tile: int = TILE, capacity: int | None = None,
              group: ProcessGroup | None = None) -> Rendering:
    """Render N Gaussians (3D Gaussian Splatting, sections 4 and 6).

    Differentiable in means, quats, scales or covars, opacities, colors, background, screen_offset and the camera's matrices;
    twice, too. Gaussians that are degenerate (not finite, zero quaternion or scale, out of range) are left out and get zero gradient.

    Args:
        means: `[N, 3]`.
        quats: `[N, 4]` (w, x, y, z), normalised inside.
        scales: `[N, 3]` standard deviations along the axes. quats and scales are None if `covars` is given.
        opacities: `[N]`, in [0, 1] as a rule; above 1 a splat is opaque farther out (alpha = min(alpha_max, o exp(-sigma))).
        colors: `[N, D]` or `[C, N, D]`, any D from 1; or with `sh_degree` SH coefficients `[N, K, D]`, K >= (sh_degree + 1)^2, of which a
            colour max(SH + 0.5, 0) is made in each camera's direction.
        camera: `Camera.look_at(eye, target, width=, height=, fov=)`, or `Camera(viewmats, Ks, width, height)` with world-to-camera matrices
            `[4, 4]` and intrinsics `[3, 3]`, or `[C, 4, 4]` and `[C, 3, 3]` for a batch. OpenCV's axes: x right, y down, z forward.
        sh_degree: 0 to 4: the bands to use of SH coefficients in `colors`.
        covars: `[N, 3, 3]` symmetric covariances.
        background: `[D]` or `[C, D]`, default zeros.
        depth: also render camera z: `"accumulated"`, sum of weight times z, or `"expected"`, that divided by alpha.
        antialiased: scale opacities by what the blur `eps2d` added to each splat's area (Mip-Splatting's 2D filter).
        eps2d: added to the diagonal of the projected covariance, in pixels squared.
        alpha_max: clamp of alpha, in (0, 1); zero gradient where it acts. (gsplat up to 1.5.3: 0.999.)
        drop_last: end pixels as peers (3DGS, gsplat) do: without the splat that takes the transmittance to 1e-4 or below, though it may weigh
            1e-2. Else what is left out weighs at most 1e-4.
        screen_offset: `[C, N, 2]` in pixels, added to the projected means. Pass zeros that require grad to get the screen-space
            gradient that density control needs, under torch.compile as well.
        absgrad: `[C, N, 2]` that requires grad; changes nothing, and receives the sum over pixels of |dL/dmean2d| (AbsGS).
        tile: pixels along the side of a tile; never visible in the result. 8, the default, is the only one on a GPU.
        capacity: room for this many hits of splats and tiles, all cameras together: then nothing waits for the GPU to count them, and CUDA
            graphs can capture the call. `meta.needed` tells how many it takes.
        group: each rank gives splats of its own and C cameras of its own, the same number on all ranks, and gets the images of its cameras with
            the splats of all ranks; gradients go to the owners. For W ranks, `colors`, `screen_offset` and `absgrad` that are per camera have
            W C for C: the own splats in the cameras of all ranks. How to train so: `tsplat.distributed`.

    Tensors are float32 or float64, all of one dtype and on one device.

    Returns:
        `Rendering`: `image` `[H, W, D]`, not clamped; `alpha` `[H, W]`, 1 minus the background's weight; `depth` `[H, W]`, or None if it was
        not asked for; `meta`, with radii, projected means and what else happened on the way. All have a leading C if the camera is a batch.

    Raises:
        ValueError, TypeError: naming the argument, what came and what is expected; on all ranks of the group where these differ.
        NotImplementedError: on a GPU where Triton is not installed, for forward-mode derivatives, and for `capacity` with `group`.

    Example, of three red splats in a row:
        >>> means = torch.tensor([[-1.0, 0, 0], [0, 0, 0], [1, 0, 0]], requires_grad=True)
        >>> quats, scales = torch.tensor([[1.0, 0, 0, 0]]).expand(3, 4), torch.full((3, 3), 0.2)
        >>> colors = torch.tensor([[1.0, 0, 0]]).expand(3, 3)
        >>> camera = tsplat.Camera.look_at((0, -1, -4), (0, 0, 0), width=64, height=48, fov=50)
        >>> rendering = tsplat.rasterize(means, quats, scales, torch.full((3,), 0.8), colors, camera)
        >>> rendering.image.shape
        torch.Size([48, 64, 3])
        >>> rendering.image.square().mean().backward()                # the gradient is in means.grad
    """
    ranks = 1
    if group is not None:
        from tsplat import distributed  # only where it is used: some builds of torch have no torch.distributed
        ranks = distributed.check_group(group)
        group = group if ranks > 1 else None            # one has nothing to exchange
    _check(means, quats, scales, opacities, colors, camera, sh_degree, covars, background, depth, antialiased, eps2d, alpha_max, drop_last,
           screen_offset, absgrad, tile, capacity, ranks)
    C, width, height = len(camera), camera.width, camera.height
    viewmats, Ks = (camera.viewmats, camera.Ks) if camera.batched else (camera.viewmats[None], camera.Ks[None])
    if group is not None:
        same = {"camera.width": width, "camera.height": height, f"camera.model (of {', '.join(MODELS)})": MODELS.index(camera.model),
                "camera.near": camera.near, "camera.far": camera.far, "eps2d": eps2d, "antialiased": antialiased,
                "channels of colors": colors.shape[-1], "sh_degree (-1: None)": -1 if sh_degree is None else sh_degree,
                "absgrad (1: given)": absgrad is not None}
        inputs = means, quats, scales, covars, opacities, colors, screen_offset, absgrad
        viewmats, Ks = distributed.gather_cameras(viewmats, Ks, group, same, inputs)
    settings = width, height, camera.model, camera.near, camera.far, eps2d, antialiased
    pairs = None
    if group is not None:
        own, pairs, counts = distributed.project(means, quats, scales, covars, opacities, colors, viewmats, Ks, settings, sh_degree, screen_offset,
                                                 absgrad)
        radii, means2d, depths, drawn = own.radii, own.means2d, own.depths, distributed.send(own, counts, group)
    else:
        radii, means2d, depths, conics, compensations = ops.project(means, quats, scales, covars, opacities, viewmats, Ks, *settings)
        if sh_degree is not None:                       # both radii are 0 of a splat that is culled
            view_colors = shade(means, camera_centers(viewmats), colors, sh_degree, radii[..., 0] > 0)
        else:
            view_colors = colors if colors.ndim == 3 else colors[None]
        radii = radii * is_finite(view_colors)[..., None]
        if screen_offset is not None:
            means2d = means2d + screen_offset
        # not expand for one camera: its gradient is a sum, a kernel
        view_opacities = opacities * compensations if antialiased else opacities[None] if C == 1 else opacities.expand(C, -1)
        drawn = Drawn(radii, means2d, conics, view_opacities, view_colors, depths, absgrad)
    mask, centers, conics, view_opacities, view_colors, zs, absgrad = drawn
    backgrounds = None if background is None else background.expand(C, -1)
    if depth is not None:
        view_colors = torch.cat([view_colors.expand(C, -1, -1), zs[..., None]], -1)
        backgrounds = None if backgrounds is None else torch.nn.functional.pad(backgrounds, (0, 1))
    to_bin = centers, mask, conics, view_opacities, zs, width, height, tile
    bins, needed = (ops.bin_splats(*to_bin), None) if capacity is None else ops.bin_splats_fixed(*to_bin, capacity)
    image, alpha = ops.blend(centers, conics, view_opacities, view_colors, backgrounds, absgrad, bins.ids, bins.offsets, width, height,
                             tile, alpha_max, drop_last)
    z = None
    if depth is not None:
        image, z = image[..., :-1], image[..., -1]
        z = z / alpha.clamp_min(1e-10) if depth == "expected" else z
    tiles_x, tiles_y = tile_counts(width, height, tile)
    meta = Meta(radii, means2d, depths, bins.offsets, (tiles_y, tiles_x), needed, pairs, (C * ranks, len(means)))
    if camera.batched:
        return Rendering(image, alpha, z, meta)
    # not image[0], of which the gradient is a zeroed and a copied image
    return Rendering(image.squeeze(0), alpha.squeeze(0), None if z is None else z.squeeze(0), meta)


def _check(means: Tensor, quats: Tensor | None, scales: Tensor | None, opacities: Tensor, colors: Tensor, camera: Camera,
           sh_degree: int | None, covars: Tensor | None, background: Tensor | None, depth: str | None, antialiased: bool, eps2d: float,
           alpha_max: float, drop_last: bool, screen_offset: Tensor | None, absgrad: Tensor | None, tile: int, capacity: int | None,
           ranks: int) -> None:
    """Errors that name the argument, what came and what is expected."""
    check_tensor("means", means, ("N", 3))
    if means.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"means: expected dtype torch.float32 or torch.float64, as half precision cannot hold a position; got {means.dtype}")
    if not isinstance(camera, Camera):
        raise TypeError(f"camera: expected a tsplat.Camera; got {type(camera).__name__}")
    N, C, views = means.shape[0], len(camera), len(camera) * ranks
    if not C:
        raise ValueError("camera: expected at least 1 camera; got a batch of 0")
    if covars is None:
        check_tensor("quats", quats, (N, 4), like=means)
        check_tensor("scales", scales, (N, 3), like=means)
    else:
        check_tensor("covars", covars, (N, 3, 3), like=means)
        if quats is not None or scales is not None:
            raise ValueError("covars: expected quats and scales to be None where covars is given")
    check_tensor("opacities", opacities, (N,), like=means)
    check_tensor("camera.viewmats", camera.viewmats, (..., 4, 4), like=means)
    if sh_degree is None:
        check_tensor("colors", colors, (N, "D") if getattr(colors, "ndim", 2) < 3 else (views, N, "D"), like=means)
    else:
        if not isinstance(sh_degree, int) or isinstance(sh_degree, bool):
            raise TypeError(f"sh_degree: expected an int from 0 to {MAX_DEGREE}; got {sh_degree!r}")
        check_choice("sh_degree", sh_degree, range(MAX_DEGREE + 1))
        check_tensor("colors", colors, (N, f"K >= {(sh_degree + 1) ** 2}", "D"), like=means)
        if colors.shape[1] < (sh_degree + 1) ** 2:
            raise ValueError(f"colors: expected at least {(sh_degree + 1) ** 2} SH coefficients [N, K, D] for sh_degree {sh_degree}; "
                             f"got {list(colors.shape)}")
    if colors.shape[-1] < 1:
        raise ValueError(f"colors: expected at least 1 channel; got shape {list(colors.shape)}")
    if background is not None:
        D = colors.shape[-1]
        check_tensor("background", background, (D,) if getattr(background, "ndim", 1) < 2 else (C, D), like=means)
    if depth is not None:
        check_choice("depth", depth, ("accumulated", "expected"))
    check_flag("antialiased", antialiased)
    check_flag("drop_last", drop_last)
    check_number("eps2d", eps2d, "a number of at least 0, in pixels squared")
    check_number("alpha_max", alpha_max, "a number in (0, 1)")
    if not 0 <= eps2d < float("inf"):
        raise ValueError(f"eps2d: expected a number of at least 0, in pixels squared; got {eps2d}")
    if not 0 < alpha_max < 1:
        raise ValueError(f"alpha_max: expected a number in (0, 1); got {alpha_max}")
    for name, probe in (("screen_offset", screen_offset), ("absgrad", absgrad)):
        if probe is not None:
            check_tensor(name, probe, (views, N, 2), like=means)
    check_size("tile", tile)
    if capacity is not None:
        check_size("capacity", capacity)
        if ranks > 1:
            raise NotImplementedError("capacity: expected None with a group of several ranks, where each call waits for the number of splats that "
                                      "come from the others")
