"""Pulsar's spheres: blending of up to 4 channels, a warp to 4 tiles of 8 x 8 pixels and a lane to a row, as in `blending.py`.

A softmax over the spheres along each ray, in one pass, as in flash attention: sums are relative to the largest term so far. The backward
computes all terms again, from the logarithm of the softmax's denominator. More channels are matrix products, in `sphere_features.py`.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from tsplat.kernels.footprint import SUMS
from tsplat.kernels.launch import Launcher, ceil_div, current_target, launch
from tsplat.kernels.sphere_features import sphere_feature_bwd_kernel, sphere_feature_fwd_kernel, sphere_features_bwd_kernel
from tsplat.kernels.sphere_geometry import (
    CHANNELS,
    CHECK,
    LOG2E,
    NO_TERM,
    Spheres,
    depth_slope,
    enter,
    far_off,
    load_sphere,
    opacity_bound,
    rays,
    reciprocal,
    term,
    term_gradients,
)
from tsplat.kernels.sphere_outlines import outlines as outlines
from tsplat.kernels.sphere_tracking import nearest_hits as nearest_hits
from tsplat.kernels.tiles import (
    TILE,
    add_tile_sums,
    block_pixels,
    blocks,
    glue,
    halves,
    lane_x,
    load_batch,
    load_pixels,
    of_batch,
    prefetch_records,
    row_dot,
    store_half,
    tile_list,
    tile_min,
)


@Launcher
@triton.jit(do_not_specialize=["W", "H", "tiles_x", "tiles_y", "null"])
def sphere_fwd_kernel(records, ids, offsets, backgrounds, gamma, Ks, image, depths, logsumexp, used, lane_x, largest, W, H, tiles_x, tiles_y,
                      null, near: tl.float64, far: tl.float64, background_depth: tl.float64, tolerance: tl.float64, D: tl.constexpr,
                      ORTHO: tl.constexpr, CHORD: tl.constexpr, DEPTH: tl.constexpr, CHECK: tl.constexpr, RECORD: tl.constexpr,
                      LANES: tl.constexpr, PTX: tl.constexpr):
    """Image `[C, H, W, D]`, depth (if DEPTH) and log-sum-exp `[C, H, W]` of a block of tiles, and how many spheres each used."""
    view, tile, exists, left, top, x, y, column4, pixel4 = block_pixels(tl.program_id(0), lane_x, tiles_x, tiles_y, W, H, LANES)
    dt: tl.constexpr = x.dtype
    half: tl.constexpr = TILE / 2
    mx, my, w, w2 = rays(Ks, view, x + (left.to(dt) + half), y, ORTHO)
    n, f, level, slope, rest, scale = depth_slope(gamma, near, far, background_depth, dt)
    b = backgrounds + view * D
    peak = x * 0.0                                      # logarithms are to base 2, relative to the background's term
    total = x * 0.0 + 1.0
    C0 = x * 0.0 + tl.load(b)
    C1 = x * 0.0 + tl.load(b + 1, mask=D > 1, other=0.0)
    C2 = x * 0.0 + tl.load(b + 2, mask=D > 2, other=0.0)
    C3 = x * 0.0 + tl.load(b + 3, mask=D > 3, other=0.0)
    Z = x * 0.0
    start, hits, longest = tile_list(offsets, tile, exists)
    i = 0
    batch = load_batch(ids, start, 0, hits, null)
    following = load_batch(ids, start, TILE, hits, null)
    while i < longest:
        later = load_batch(ids, start, i + 2 * TILE, hits, null)
        prefetch_records(records, following, RECORD, PTX)
        u = 0
        while u < TILE:
            sphere = load_sphere(records, of_batch(batch, u, ids, start, i, hits, null, PTX), RECORD)
            X, Y, depth, R, o = sphere[:5]
            distance = far_off(X, Y, depth)
            _, s, _, _, distance_in = enter(mx, my, w, w2, X, Y, depth, R, reciprocal(R, PTX), distance, ORTHO, CHORD, PTX)
            hit = (s < 1.0) & (distance_in >= n) & (distance_in <= f)
            logit = tl.where(hit, (o * level - rest) - (o * slope) * distance_in, float("-inf"))
            # one of the two exponentials, of this term and of what was before it, both relative to the larger one, is 1
            less = tl.exp2(-tl.abs(logit - peak))
            higher = logit > peak
            e = tl.where(higher, 1.0, less) * (o - o * s)
            shrink = tl.where(higher, less, 1.0)
            peak = tl.maximum(peak, logit)
            total = total * shrink + e
            C0 = C0 * shrink + sphere[5] * e
            if D > 1:
                C1 = C1 * shrink + sphere[6] * e
            if D > 2:
                C2 = C2 * shrink + sphere[7] * e
            if D > 3:
                C3 = C3 * shrink + sphere[8] * e
            if DEPTH:
                Z = Z * shrink + distance_in * e
            u += 1
        i += TILE
        batch = following
        following = later
        if (i % CHECK == 0) & (i < longest):
            # of the spheres that are left, none is nearer than the next or more opaque than the most
            first = load_sphere(records, tl.load(ids + start + i, mask=i < hits, other=null), RECORD)
            nearest = (first[2] if ORTHO else far_off(first[0], first[1], first[2])) - first[3]
            z = 1.0 - tl.minimum(tl.maximum((nearest - n) / (f - n), 0.0), 1.0)
            most = opacity_bound(largest)
            bound = tl.log2(tl.maximum(hits - i, 1).to(dt)) + tl.log2(most) + (most * z * scale - rest)
            least = tile_min(tl.min(peak + tl.log2(total), 1, keep_dims=True))
            hits = tl.where(bound > tl.log2(tl.full((), tolerance, dt)) + least, hits, tl.minimum(hits, i))
            longest = tl.max(tl.max(hits, 1), 0)
            batch = load_batch(ids, start, i, hits, null)
            following = load_batch(ids, start, i + TILE, hits, null)
    tl.store(used + tile, hits, mask=exists & (tl.arange(0, LANES)[:, None] % TILE == 0))
    inverse = 1.0 / total
    peak = (peak + tl.log2(total)) / tl.full((), LOG2E, dt)
    C0, D0 = halves(C0 * inverse)
    C1, D1 = halves(C1 * inverse)
    C2, D2 = halves(C2 * inverse)
    C3, D3 = halves(C3 * inverse)
    peak, peak1 = halves(peak)
    Z, Z1 = halves(Z * inverse)
    other = depths if DEPTH else None
    store_half(image, logsumexp, other, C0, C1, C2, C3, peak, Z, view, left, top, W, H, 0, D)
    store_half(image, logsumexp, other, D0, D1, D2, D3, peak1, Z1, view, left, top, W, H, 4, D)


@Launcher
@triton.jit(do_not_specialize=["W", "H", "tiles_x", "tiles_y", "null"])
def sphere_bwd_kernel(records, ids, offsets, used, gamma, Ks, cutoff, logsumexp, common, v_image, v_depth, sums, v_rays, lane_x, W, H, tiles_x,
                      tiles_y, null, near: tl.float64, far: tl.float64, background_depth: tl.float64, D: tl.constexpr, ORTHO: tl.constexpr,
                      CHORD: tl.constexpr, EPS: tl.constexpr, PER_HIT: tl.constexpr, RECORD: tl.constexpr, LANES: tl.constexpr, PTX: tl.constexpr):
    """Sums over the pixels, per sphere `[R + 1, SUMS]` (atomic), or per hit `[M, SUMS]` (PER_HIT, for the same bits in every run): gradients
    of the centre (3), the radius, the opacity, gamma and the features (4). v_rays (or None): `[blocks, LANES, 4]`, sums over the pixels of
    lanes of the gradients of mx and my, and of these times mx and my.
    """
    block = tl.program_id(0)
    view, tile, exists, left, top, x, y, column4, pixel4 = block_pixels(block, lane_x, tiles_x, tiles_y, W, H, LANES)
    dt: tl.constexpr = x.dtype
    half: tl.constexpr = TILE / 2
    mx, my, w, w2 = rays(Ks, view, x + (left.to(dt) + half), y, ORTHO)
    n, f, level, slope, rest, scale = depth_slope(gamma, near, far, background_depth, dt)
    inv_gamma = 1.0 / tl.load(gamma)
    depth1 = 1.0 / (f - n)
    depth0 = 1.0 + n * depth1
    v0 = load_pixels(v_image, pixel4, column4, W, D, 0)
    v1 = load_pixels(v_image, pixel4, column4, W, D, 1)
    v2 = load_pixels(v_image, pixel4, column4, W, D, 2)
    v3 = load_pixels(v_image, pixel4, column4, W, D, 3)
    base = load_pixels(common, pixel4, column4, W, 1, 0)
    # beyond the border so large that all terms are 0
    lse = load_pixels(logsumexp, pixel4, column4, W, 1, 0) * tl.full((), LOG2E, dt)
    lse = tl.where(glue(column4, column4 + 1) < W, lse, NO_TERM)
    none = tl.sum(x * 0.0, 1, keep_dims=True)
    v_mx = x * 0.0
    v_my = x * 0.0
    v_z = None
    if v_depth is not None:
        v_z = load_pixels(v_depth, pixel4, column4, W, 1, 0)
    last = f
    if cutoff is not None:
        last = tl.minimum(load_pixels(cutoff, pixel4, column4, W, 1, 0), f)
    start = tl.load(offsets + tile, mask=exists, other=0)
    hits = tl.load(used + tile, mask=exists, other=0)
    longest = tl.max(tl.max(hits, 1), 0)
    i = 0
    batch = load_batch(ids, start, 0, hits, null)
    following = load_batch(ids, start, TILE, hits, null)
    while i < longest:
        later = load_batch(ids, start, i + 2 * TILE, hits, null)
        prefetch_records(records, following, RECORD, PTX)
        stop = tl.minimum(TILE, longest - i)
        u = 0
        while u < stop:
            index = of_batch(batch, u, ids, start, i, hits, null, PTX)
            real = i + u < hits
            sphere = load_sphere(records, index, RECORD)
            X, Y, depth, R, o = sphere[:5]
            distance = far_off(X, Y, depth)
            r = reciprocal(R, PTX)
            t, s, h, a, distance_in = enter(mx, my, w, w2, X, Y, depth, R, r, distance, ORTHO, CHORD, PTX)
            hit = (s < 1.0) & (distance_in >= n) & (distance_in <= last)
            logit = (o * level - rest) - (o * slope) * distance_in - lse
            e = term(logit, hit, o)
            if cutoff is not None:                      # as it is, and not relative to a sum that does not vanish
                logit = o * level - (o * slope) * distance_in
            g = base + sphere[5] * v0
            if D > 1:
                g += sphere[6] * v1
            if D > 2:
                g += sphere[7] * v2
            if D > 3:
                g += sphere[8] * v3
            if v_depth is not None:
                g += distance_in * v_z
            s0, s1, s2, s3, s4, s5, pixel_mx, pixel_my = term_gradients(
                g, e, logit, v_z, t, s, h, a, distance_in, mx, my, w, w2, X, Y, depth, R, r, o, distance, -(o * depth1) * inv_gamma, inv_gamma,
                depth0, depth1, EPS, 1, ORTHO, CHORD, PTX)
            if v_rays is not None:
                v_mx += pixel_mx
                v_my += pixel_my
            weight = e - e * s
            c0 = o * row_dot(weight, v0)
            c1 = o * row_dot(weight, v1) if D > 1 else none
            c2 = o * row_dot(weight, v2) if D > 2 else none
            c3 = o * row_dot(weight, v3) if D > 3 else none
            COUNT: tl.constexpr = 12 if D > 3 else 9
            row = start + i + u if PER_HIT else index.to(tl.int64)
            add_tile_sums(sums + row * SUMS, s0, s1, s2, s3, s4, s5, c0, c1, c2, c3, none, none, real, COUNT, PER_HIT, PTX)
            u += 1
        i += TILE
        batch = following
        following = later
    if v_rays is not None:
        q = v_rays + (block.to(tl.int64) * LANES + tl.arange(0, LANES)[:, None]) * 4
        tl.store(q, tl.sum(v_mx, 1, keep_dims=True))
        tl.store(q + 1, tl.sum(v_my, 1, keep_dims=True))
        tl.store(q + 2, tl.sum(v_mx * mx, 1, keep_dims=True))
        tl.store(q + 3, tl.sum(v_my * my, 1, keep_dims=True))


@Launcher
@triton.jit(do_not_specialize=["pixels", "D"])
def upstream_kernel(image, depths, logsumexp, backgrounds, gamma, v_image, v_depth, v_logsumexp, common, partials, pixels, D,
                    background_depth: tl.float64, CUT: tl.constexpr, DB: tl.constexpr, BLOCK: tl.constexpr):
    """What the gradients of all terms of a pixel's softmax have in common, common `[C, pixels]` (`tsplat_reference.softmax_gradient`), and
    sums over BLOCK pixels, partials `[C, blocks, D + 1]`, of the gradients of the background and of what is left of gamma's without the spheres'
    (`background_gradients` of the reference)."""
    view = tl.program_id(1).to(tl.int64)
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = p < pixels
    at = view * pixels + p
    dt: tl.constexpr = image.dtype.element_ty
    inv_gamma = 1.0 / tl.load(gamma)
    lse = tl.load(logsumexp + at, mask=inside, other=NO_TERM)
    weight = tl.exp(-lse)                                               # of the background
    v_lse = weight * 0.0 if v_logsumexp is None else tl.load(v_logsumexp + at, mask=inside, other=0.0)
    relative = tl.full((), background_depth, dt) * inv_gamma if CUT else -lse
    same = v_lse
    if v_depth is not None:
        same -= tl.load(depths + at, mask=inside, other=0.0) * tl.load(v_depth + at, mask=inside, other=0.0)
    behind = same * 0.0
    out = partials + (view * tl.num_programs(0) + tl.program_id(0)) * (D + 1)
    begin = 0
    while begin < D:
        d = begin + tl.arange(0, DB)
        mask = inside[:, None] & (d < D)[None, :]
        index = at[:, None] * D + d[None, :]
        v = tl.load(v_image + index, mask=mask, other=0.0)
        same -= tl.sum(v * tl.load(image + index, mask=mask, other=0.0), 1)
        behind += tl.sum(v * tl.load(backgrounds + view * D + d, mask=d < D, other=0.0)[None, :], 1)
        tl.store(out + d, tl.sum(v * weight[:, None], 0), mask=d < D)
        begin += DB
    tl.store(common + at, same, mask=inside)
    tl.store(out + D, inv_gamma * tl.sum((v_lse - weight * (same + behind)) * relative, 0))


def blend_spheres_backward(centers: Tensor, radii: Tensor, opacities: Tensor, features: Tensor, backgrounds: Tensor, gamma: Tensor, Ks: Tensor,
                           ids: Tensor, offsets: Tensor, cutoff: Tensor | None, images: tuple[Tensor, Tensor, Tensor, Tensor], v_image: Tensor,
                           v_depth: Tensor | None, v_logsumexp: Tensor | None, width: int, height: int, tile: int, model: str, near: float,
                           far: float, background_depth: float, chord: bool, intrinsics: bool
                           ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Launcher; see `tsplat_reference.blend_sphere_blocks_backward`.

    Sums over pixels are atomic, so that their last bits differ from run to run, but not under `torch.use_deterministic_algorithms(True)`:
    then each hit has a row of sums of its own (48 bytes), added up in order; more than 4 channels take a pass per 4.
    """
    image, depths, logsumexp, used = (v.contiguous() for v in images)
    v_image, backgrounds = v_image.contiguous(), backgrounds.contiguous()
    v_depth, v_logsumexp, cutoff = (None if v is None else v.contiguous() for v in (v_depth, v_logsumexp, cutoff))
    C, D, options = len(centers), features.shape[2], launch("upstream")
    common, programs = torch.empty_like(logsumexp), ceil_div(width * height, options["BLOCK"])
    partials = centers.new_empty(C, programs, D + 1)
    upstream_kernel[(programs, C)](image, depths, logsumexp, backgrounds, gamma, v_image, v_depth, v_logsumexp, common, partials,
                                   width * height, D, background_depth, CUT=cutoff is not None, **options)
    behind = partials.sum(1)

    def terms(some: slice, common: Tensor, v_depth: Tensor | None) -> list[Tensor]:
        s = Spheres(centers, radii, opacities, features[..., some], Ks, ids, offsets, width, height, tile)
        return _terms_backward(s, radii, opacities, gamma, cutoff, logsumexp, used, v_image[..., some].contiguous(), common, v_depth, width,
                               height, model, near, far, background_depth, chord, intrinsics)

    if D <= CHANNELS or not torch.are_deterministic_algorithms_enabled():
        v_features, *rest = terms(slice(None), common, v_depth)
    else:                                               # linear in what is upstream, of which all but the image goes with the first pass
        parts = [terms(slice(0, CHANNELS), common, v_depth)]
        parts += [terms(slice(c, c + CHANNELS), torch.zeros_like(common), None) for c in range(CHANNELS, D, CHANNELS)]
        v_features, *rest = torch.cat([p[0] for p in parts], -1), *(torch.stack(v).sum(0) for v in list(zip(*parts, strict=True))[1:])
    v_centers, v_radii, v_opacities, v_gamma, v_Ks = rest
    return v_centers, v_radii, v_opacities, v_features, behind[:, :D].contiguous(), v_gamma + behind[:, D].sum(), v_Ks


def _terms_backward(s: Spheres, radii: Tensor, opacities: Tensor, gamma: Tensor, cutoff: Tensor | None, logsumexp: Tensor, used: Tensor,
                    v_image: Tensor, common: Tensor, v_depth: Tensor | None, width: int, height: int, model: str, near: float, far: float,
                    background_depth: float, chord: bool, intrinsics: bool) -> list[Tensor]:
    """Gradients of features, centers, radii, opacities, gamma and Ks by way of the spheres' terms."""
    deterministic = torch.are_deterministic_algorithms_enabled()
    target = current_target()
    ptx = target.ptx and gamma.dtype == torch.float32
    sums = gamma.new_zeros(len(s.ids) if deterministic else s.R + 1, SUMS.value)
    flags = {"ORTHO": model == "orthographic", "CHORD": chord and model == "pinhole", "PTX": ptx}
    size, eps = (width, height, *s.grid, s.R), torch.finfo(gamma.dtype).eps
    v_features = None
    if s.few:
        count = blocks(s.grid, target.lanes)
        v_rays = gamma.new_empty(s.C, count * target.lanes, 4) if intrinsics else None
        sphere_bwd_kernel[(s.C * count,)](
            s.records, s.ids, s.offsets, used, gamma, s.Ks, cutoff, logsumexp, common, v_image, v_depth, sums, v_rays,
            lane_x(target.lanes, gamma), *size, near, far, background_depth, D=s.D, EPS=eps, PER_HIT=deterministic, RECORD=s.record,
            LANES=target.lanes, **flags, **launch("blend_spheres_backward"))
        if deterministic:
            sums = gamma.new_zeros(s.R + 1, SUMS.value).index_add_(0, s.ids.long(), sums)
    else:
        v_features, rows = torch.zeros_like(s.features), max(len(s.features) * s.N, 1)
        v_rays = gamma.new_empty(s.C, s.tiles // s.C, 4) if intrinsics else None
        block = {"P": TILE.value**2, "PRECISION": "tf32x3" if ptx else "ieee", **flags}
        options = launch("sphere_features_backward")
        sphere_features_bwd_kernel[(s.tiles, ceil_div(s.D, options["DB"]))](
            s.records, s.ids, s.offsets, used, gamma, s.Ks, cutoff, logsumexp, v_image, v_features, *size, rows, s.D, near, far,
            background_depth, **block, **options)
        feature_backward = "sphere_feature_backward" if v_rays is None else "sphere_feature_cameras_backward"
        sphere_feature_bwd_kernel[(s.tiles,)](
            s.records, s.features, s.ids, s.offsets, used, gamma, s.Ks, cutoff, logsumexp, common, v_image, v_depth, sums, v_rays, *size, rows,
            s.D, near, far, background_depth, EPS=eps, **block, **launch(feature_backward))
    *gradients, v_some = s.gradients(sums[:s.R], radii, opacities)
    return [v_some if v_features is None else v_features, *gradients, sums[:s.R, 5].sum(), _intrinsics_gradient(s.Ks, v_rays)]


def _intrinsics_gradient(Ks: Tensor, v_rays: Tensor | None) -> Tensor:
    """From the gradients of mx = (u - cx)/fx and my `[C, .., 4]`, as `sphere_bwd_kernel` has them; empty without."""
    if v_rays is None:
        return Ks.new_empty(0)
    diagonal, last = slice(0, 5, 4), slice(2, 6, 3)                     # of the first two rows, flat
    v = -v_rays.sum(1).view(-1, 2, 2) / Ks.view(-1, 1, 9)[..., diagonal]
    v_Ks = torch.zeros_like(Ks).view(-1, 9)
    v_Ks[:, last], v_Ks[:, diagonal] = v[:, 0], v[:, 1]
    return v_Ks.view_as(Ks)


def blend_spheres(centers: Tensor, radii: Tensor, opacities: Tensor, features: Tensor, backgrounds: Tensor, gamma: Tensor, Ks: Tensor,
                  ids: Tensor, offsets: Tensor, width: int, height: int, tile: int, model: str, near: float, far: float,
                  background_depth: float, chord: bool, depth: bool, tolerance: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Launcher; see `tsplat_reference.blend_sphere_blocks`. Tiles are 8 pixels wide."""
    s = Spheres(centers, radii, opacities, features, Ks, ids, offsets, width, height, tile)
    image, logsumexp = centers.new_empty(s.C, height, width, s.D), centers.new_empty(s.C, height, width)
    depths, used = centers.new_empty(s.C, height if depth else 0, width), ids.new_empty(s.tiles, dtype=torch.int32)
    target = current_target()
    ptx = target.ptx and centers.dtype == torch.float32
    flags = {"ORTHO": model == "orthographic", "CHORD": chord and model == "pinhole", "DEPTH": depth,
             "CHECK": CHECK if tolerance > 0 else 1 << 30, "PTX": ptx}
    largest = opacities.amax() if tolerance > 0 and s.R else gamma         # any pointer, if it is not read
    out, scalars = (image, depths, logsumexp, used), (near, far, background_depth, tolerance)
    if s.few:
        sphere_fwd_kernel[(s.C * blocks(s.grid, target.lanes),)](
            s.records, s.ids, s.offsets, backgrounds.contiguous(), gamma, s.Ks, *out, lane_x(target.lanes, centers), largest, width, height,
            *s.grid, s.R, *scalars, D=s.D, RECORD=s.record, LANES=target.lanes, **flags, **launch("blend_spheres"))
    else:
        options = launch("sphere_features")
        sphere_feature_fwd_kernel[(s.tiles, ceil_div(s.D, options["DB"]))](
            s.records, s.features, s.ids, s.offsets, backgrounds.contiguous(), gamma, s.Ks, *out, largest, width, height, *s.grid, s.R,
            max(len(features) * s.N, 1), s.D, *scalars, P=tile * tile, PRECISION="tf32x3" if ptx else "ieee", **flags, **options)
    return out
