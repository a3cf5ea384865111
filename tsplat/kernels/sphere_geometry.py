"""Rays, spheres and their gradients as device functions, and the records of spheres.

The functions take pixels and spheres of shapes that broadcast: pixels of a lane by its one sphere, `[LANES, 8]` and `[LANES, 1]`, or a tile's
pixels by a block of spheres, `[P, 1]` and `[1, K]`. With m = (mx, my, 1) the ray of a pixel, w = 1/|m|, c the centre of a sphere and r = 1/R:

    t = |c x m|^2 / |m|^2 / R^2,  h = sqrt(1 - t),  a = c m / |m|,  D = a - R h,  s = sqrt(t) or, with `chord`, sqrt(2 t/(1 + a/|c|)).

A record is 8 numbers, two 16-byte loads and one sector: x, y, z, R | opacity, feature 0, 1, 2; with 4 features it is 12, feature 3 and three
that pad. The record behind the last is the null sphere, which is nowhere.
"""

from __future__ import annotations

import math

import triton
import triton.language as tl
from torch import Tensor

from tsplat.kernels.footprint import SUMS, store4
from tsplat.kernels.launch import Launcher, ceil_div, launch
from tsplat.kernels.tiles import TILE, load4, row_dot

CHANNELS = 4
"""Up to here a sphere's features are in its record and a pixel's in registers."""
CHECK = 64
"""Spheres after which a tile may end: as in the reference, so that the same count."""
LOG2E = tl.constexpr(math.log2(math.e))
NO_TERM = tl.constexpr(1e30)
"""For the logarithm of a sum, where there is no pixel: all terms are 0, relative to it."""
NOWHERE = tl.constexpr(1e15)
"""x of the null sphere, of radius 1: no ray reaches that, and its square is a float32."""


@triton.jit
def rays(Ks, view, u, v, ORTHO: tl.constexpr):
    """Rays through pixels u, v: mx, my, w and w^2."""
    K = Ks + 9 * view.to(tl.int64)
    mx = (u - tl.load(K + 2)) / tl.load(K)
    my = (v - tl.load(K + 5)) / tl.load(K + 4)
    if ORTHO:
        w2 = mx * 0.0 + 1.0
    else:
        w2 = 1.0 / (mx * mx + my * my + 1.0)
    return mx, my, tl.sqrt(w2), w2


@triton.jit
def reciprocal(v, PTX: tl.constexpr):
    """1/v, in PTX in one instruction."""
    if PTX:
        return tl.inline_asm_elementwise("rcp.approx.ftz.f32 $0, $1;", "=f,f", [v], dtype=tl.float32, is_pure=True, pack=1)
    else:
        return 1.0 / v


@triton.jit
def product(mx, my, x, y, z):
    """Vector product of centre and ray; what depends on my alone is computed once where a lane's pixels share a row."""
    return z * mx - x, z * my - y, x * my - y * mx


@triton.jit
def enter(mx, my, w, w2, x, y, z, R, r, distance, ORTHO: tl.constexpr, CHORD: tl.constexpr, PTX: tl.constexpr):
    """t, s, h, a and D; t = s = 1 where the ray misses. `distance`, of the centre, is for `chord`."""
    if ORTHO:
        px = (mx - x) * r
        py = (my - y) * r
        t = py * py + px * px
        a = z
    else:
        px, py, pz = product(mx, my, x * r, y * r, z * r)
        t = (py * py + px * px + pz * pz) * w2
        a = ((y * my + z) + x * mx) * w
    t = tl.minimum(t, 1.0)
    h = tl.sqrt(1.0 - t)
    if CHORD:
        s = tl.sqrt(tl.minimum(t * (2.0 * distance * reciprocal(distance + tl.maximum(a, 0.0), PTX)), 1.0))
    else:
        s = tl.sqrt(t)
    return t, s, h, a, a - R * h


@triton.jit
def far_off(x, y, z):
    """Distance of a centre."""
    return tl.sqrt(x * x + y * y + z * z)


@triton.jit
def load_sphere(records, sphere, RECORD: tl.constexpr):
    """Each lane's sphere: x, y, z, R, opacity, 3 features, and four more or copies of these."""
    p = records + sphere.to(tl.int64) * RECORD
    if RECORD == 8:
        first = load4(p)
        second = load4(p + 4)
        return first + second + second
    else:
        return load4(p) + load4(p + 4) + load4(p + 8)


@triton.jit
def depth_slope(gamma, near, far, background_depth, dt: tl.constexpr):
    """near and far, and with log2(e)/gamma for 1: (p, q), so that 1 - (D - near)/(far - near) = p - q D; the background's depth, to which
    all logarithms of terms are relative; and 1."""
    n = tl.full((), near, dt)
    f = tl.full((), far, dt)
    scale = tl.full((), LOG2E, dt) / tl.load(gamma)
    return n, f, scale * (1.0 + n / (f - n)), scale / (f - n), tl.full((), background_depth, dt) * scale, scale


@triton.jit
def opacity_bound(largest):
    """The largest opacity, at least 1; 1e30, so that no tile ends early, if that is not a number (spheres with such are left out)."""
    most = tl.load(largest)
    return tl.where(most >= 0, tl.minimum(tl.maximum(most, 1.0), 1e30), 1e30)


@triton.jit
def term(logit, hit, o):
    """2^logit of an opacity o, where it hits, else 0; logit relative to the logarithm of the softmax's denominator.

    o d 2^logit is at most 1, and d at least half the eps of 1, so that there is a limit. It acts at an outline where the forward rounded a
    tiny d to a miss and has no such term in its sum: else that might be any number.
    """
    LIMIT: tl.constexpr = 54 if logit.dtype == tl.float64 else 25
    limit = LIMIT - tl.log2(tl.maximum(o, tl.full((), 1e-30, logit.dtype)))
    return tl.where(hit, tl.exp2(tl.minimum(logit, limit)), 0.0)


@triton.jit
def total(v, AXIS: tl.constexpr):
    """Sum over pixels."""
    return tl.sum(v, AXIS, keep_dims=True)


@triton.jit
def dot(a, b, AXIS: tl.constexpr):
    """Sum of a b over pixels."""
    if AXIS == 1:
        return row_dot(a, b)
    else:
        return tl.sum(a * b, AXIS, keep_dims=True)


@triton.jit
def term_gradients(g, e, log_e, v_depth, t, s, h, a, D, mx, my, w, w2, x, y, z, R, r, o, distance, slope, inv_gamma, depth0, depth1,
                   EPS: tl.constexpr, AXIS: tl.constexpr, ORTHO: tl.constexpr, CHORD: tl.constexpr, PTX: tl.constexpr):
    """Gradients of the centre (3), the radius, the opacity and gamma, summed over pixels; and of mx and my.

    The terms of the softmax are e o d with d = 1 - s, and e = exp(o z/gamma - logsumexp), 0 where missed; g: what o d e's gradient is over
    that (`softmax_gradient`, and the features' and depth's part). log_e: to base 2, what gamma's gradient is of (`background_gradients` of the
    reference). slope: dlog e/dD. All is o times what is computed here from e by products
    alone, so that o = 0, d = 0 and rays through a centre are nothing special.
    """
    LEAST: tl.constexpr = EPS**0.5 / 2                  # of s: below, a ray goes through the centre as far as its rounding tells
    least = tl.full((), LEAST, mx.dtype)
    d = 1.0 - s
    ge = g * e
    v_e = ge * d
    sum_e = total(v_e, AXIS)
    sum_ez = (depth0 * sum_e - depth1 * dot(v_e, D, AXIS)) * inv_gamma                   # z/gamma is depth0 - depth1 D, over gamma
    v_o = sum_e + o * sum_ez
    v_gamma = -o * inv_gamma * dot(v_e, log_e, AXIS) * tl.full((), 1 / LOG2E, mx.dtype)
    along = ge * slope                                                                      # dL/dD over o d
    if v_depth is not None:
        along += e * v_depth
    v_D = along * d
    # D = a - R sqrt(1 - t): d/h = h/(1 + s) loses nothing at the outline (with chord, h is larger and division safe)
    if CHORD:
        v_t = (0.5 * R) * v_D * reciprocal(tl.maximum(h, least), PTX)
    else:
        v_t = (0.5 * R) * along * (h * reciprocal(1.0 + s, PTX))
    v_s2 = -0.5 * ge * reciprocal(tl.maximum(s, least), PTX)
    v_a = v_D
    if CHORD:
        factor = 2.0 * distance * reciprocal(distance + tl.maximum(a, 0.0), PTX)            # s^2 = t factor
        v_t += v_s2 * factor
        v_ratio = v_s2 * t * (0.5 * factor * factor)                                        # minus dL/d(a/distance)
        v_a -= v_ratio / distance
    else:
        v_t += v_s2
    v_R = -o * (dot(v_D, h, AXIS) + (2.0 * r) * dot(v_t, t, AXIS))
    if ORTHO:
        u = v_t * (2.0 * r * r)
        v_mx = u * (mx - x)
        v_my = u * (my - y)
        v_x = -o * total(v_mx, AXIS)
        v_y = -o * total(v_my, AXIS)
        v_z = o * total(v_a, AXIS)
    else:
        px, py, pz = product(mx, my, x * r, y * r, z * r)
        u = v_t * (2.0 * w2)                            # dL/dp over p
        k = v_a * w
        ux = u * px
        uz = u * pz
        X = dot(k, mx, AXIS) - r * total(ux, AXIS)
        Z = total(k, AXIS) + r * dot(ux, mx, AXIS)
        Y = -r * dot(uz, mx, AXIS)
        if AXIS == 1:                                   # a lane's pixels have one my, and so one py
            v_py = py * total(u, AXIS)
            X += r * my * total(uz, AXIS)
            Y += my * total(k, AXIS) - r * v_py
            Z += r * my * v_py
        else:
            X += r * dot(uz, my, AXIS)
            Y += dot(k, my, AXIS) - r * dot(u, py, AXIS)
            Z += r * dot(u * py, my, AXIS)
        if CHORD:
            by_distance = dot(v_ratio, a, AXIS) / (distance * distance * distance)
            X += by_distance * x
            Y += by_distance * y
            Z += by_distance * z
        v_x = o * X
        v_y = o * Y
        v_z = o * Z
        aw = a * w
        v_mx = r * (z * ux - y * uz) - u * t * mx + k * (x - aw * mx)
        v_my = r * (z * py * u + x * uz) - u * t * my + k * (y - aw * my)
    return v_x, v_y, v_z, v_R, v_o, v_gamma, o * v_mx, o * v_my


@Launcher
@triton.jit(do_not_specialize=["R", "radii_rows", "opacity_rows", "feature_rows"])
def pack_spheres_kernel(centers, radii, opacities, features, records, R, radii_rows, opacity_rows, feature_rows, D: tl.constexpr,
                        RECORD: tl.constexpr, BLOCK: tl.constexpr):
    """Records of spheres with D features, of which sphere i takes row i mod the number of rows: here once per sphere, so that blending need
    not. Record R is the null sphere."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    real = i < R
    inside = i <= R
    p = records + RECORD * i
    row = features + (i % feature_rows) * D
    store4(p, tl.load(centers + 3 * i, mask=real, other=NOWHERE), tl.load(centers + 3 * i + 1, mask=real, other=0.0),
           tl.load(centers + 3 * i + 2, mask=real, other=0.0), tl.load(radii + i % radii_rows, mask=real, other=1.0), inside)
    store4(p + 4, tl.load(opacities + i % opacity_rows, mask=real, other=0.0), tl.load(row, mask=real & (D > 0), other=0.0),
           tl.load(row + 1, mask=real & (D > 1), other=0.0), tl.load(row + 2, mask=real & (D > 2), other=0.0), inside)
    if RECORD > 8:
        f3 = tl.load(row + 3, mask=real & (D > 3), other=0.0)
        store4(p + 8, f3, f3, f3, f3, inside)


@Launcher
@triton.jit(do_not_specialize=["R"])
def unpack_spheres_kernel(sums, v_centers, v_radii, v_opacities, v_features, R, D: tl.constexpr, BLOCK: tl.constexpr):
    """Sums `[R, SUMS]` to the gradients of centres, radii, opacities and D features."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    real = i < R
    p = sums + SUMS * i
    for axis in tl.static_range(3):
        tl.store(v_centers + 3 * i + axis, tl.load(p + axis, mask=real), mask=real)
    tl.store(v_radii + i, tl.load(p + 3, mask=real), mask=real)
    tl.store(v_opacities + i, tl.load(p + 4, mask=real), mask=real)
    for channel in tl.static_range(D):
        tl.store(v_features + i * D + channel, tl.load(p + 6 + channel, mask=real), mask=real)


class Spheres:
    """Arguments of the kernels, contiguous, with records packed."""

    def __init__(self, centers: Tensor, radii: Tensor, opacities: Tensor, features: Tensor, Ks: Tensor, ids: Tensor, offsets: Tensor,
                 width: int, height: int, tile: int) -> None:
        if tile != TILE.value:
            raise ValueError(f"tile: expected {TILE.value}, the tile of the Triton kernels; got {tile}")
        (self.C, self.N), self.D = centers.shape[:2], features.shape[2]
        self.R, self.few = self.C * self.N, features.shape[2] <= CHANNELS
        self.features, self.Ks, self.ids, self.offsets = features.contiguous(), Ks.contiguous(), ids.contiguous(), offsets.contiguous()
        self.grid = ceil_div(width, tile), ceil_div(height, tile)
        self.tiles = self.C * self.grid[0] * self.grid[1]
        self.record = 12 if self.D == CHANNELS else 8
        self.records = centers.new_empty(self.R + 1, self.record)
        options = launch("records")
        pack_spheres_kernel[(ceil_div(self.R + 1, options["BLOCK"]),)](
            centers.contiguous(), radii.contiguous(), opacities.contiguous(), self.features, self.records, self.R,
            *(max(v.shape[0] * self.N, 1) for v in (radii, opacities, features)), D=self.D if self.few else 0, RECORD=self.record, **options)

    def gradients(self, sums: Tensor, radii: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Of centres, radii, opacities and up to 4 features, from the sums `[R, SUMS]`."""
        C, N, D = self.C, self.N, self.D if self.few else 0
        each = sums.new_empty(C, N, 3), sums.new_empty(C, N), sums.new_empty(C, N), sums.new_empty(C, N, D)
        if self.R:
            options = launch("records")
            unpack_spheres_kernel[(ceil_div(self.R, options["BLOCK"]),)](sums, *each, self.R, D=D, **options)
        v_centers, v_radii, v_opacities, v_features = (v if len(v) == len(x) else v.sum(0, keepdim=True) for v, x in zip(
            each, (each[0], radii, opacities, self.features), strict=True))
        return v_centers, v_radii, v_opacities, v_features
