"""Spherical harmonics of degree 0 to 4 and their backward: a splat per thread, its coefficients in registers for all cameras.

Bound by memory: at degree 3 a splat has 192 bytes of coefficients. So a thread takes its row in 16-byte loads (and leaves it if no camera
sees the splat), and a block of splats is a loop over the cameras, which also gives every sum over cameras a fixed order.
"""

from __future__ import annotations

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from tsplat.kernels.camera import dot, load_row, stack, store_row
from tsplat.kernels.launch import Launcher, ceil_div, launch

HELD = 50
"""Coefficients that a thread holds at the most if there are more than 3 channels; from 64 on, some targets run out of registers."""

# sqrt((2l + 1)/(4 pi) (l - m)!/(l + m)!), sqrt(2) times that for m > 0, with the denominators of the Legendre polynomials below taken in
N00 = tl.constexpr(math.sqrt(1 / (4 * math.pi)))
N10 = tl.constexpr(math.sqrt(3 / (4 * math.pi)))
N20 = tl.constexpr(math.sqrt(5 / (16 * math.pi)))
N21 = tl.constexpr(math.sqrt(15 / (4 * math.pi)))
N22 = tl.constexpr(math.sqrt(15 / (16 * math.pi)))
N30 = tl.constexpr(math.sqrt(7 / (16 * math.pi)))
N31 = tl.constexpr(math.sqrt(21 / (32 * math.pi)))
N32 = tl.constexpr(math.sqrt(105 / (16 * math.pi)))
N33 = tl.constexpr(math.sqrt(35 / (32 * math.pi)))
N40 = tl.constexpr(math.sqrt(9 / (256 * math.pi)))
N41 = tl.constexpr(math.sqrt(45 / (32 * math.pi)))
N42 = tl.constexpr(math.sqrt(45 / (64 * math.pi)))
N43 = tl.constexpr(math.sqrt(315 / (32 * math.pi)))
N44 = tl.constexpr(math.sqrt(315 / (256 * math.pi)))


@triton.jit
def azimuth(x, y):
    """Real and imaginary parts of (x + i y)^2, ^3 and ^4: sin^m(theta) times cos and sin of m phi."""
    c2 = x * x - y * y
    s2 = 2.0 * x * y
    c3 = x * c2 - y * s2
    s3 = x * s2 + y * c2
    return c2, s2, c3, s3, x * c3 - y * s3, x * s3 + y * c3


@triton.jit
def constant(z):
    """Band 0."""
    return (tl.zeros_like(z) + N00,)


@triton.jit
def basis(x, y, z, DEGREE: tl.constexpr):
    """The functions at unit directions: a polynomial in z for each order m, times cos or sin of m phi; m from -l to l in band l."""
    c2, s2, c3, s3, c4, s4 = azimuth(x, y)
    b = constant(z)
    if DEGREE >= 1:
        b += (y * -N10, z * N10, x * -N10)
    if DEGREE >= 2:
        p1 = z * -N21
        b += (s2 * N22, y * p1, (3.0 * z * z - 1.0) * N20, x * p1, c2 * N22)
    if DEGREE >= 3:
        p1 = (5.0 * z * z - 1.0) * -N31
        p2 = z * N32
        b += (s3 * -N33, s2 * p2, y * p1, (5.0 * z * z - 3.0) * z * N30, x * p1, c2 * p2, c3 * -N33)
    if DEGREE >= 4:
        zz = z * z
        p1 = (7.0 * zz - 3.0) * z * -N41
        p2 = (7.0 * zz - 1.0) * N42
        p3 = z * -N43
        b += (s4 * N44, s3 * p3, s2 * p2, y * p1, ((35.0 * zz - 30.0) * zz + 3.0) * N40, x * p1, c2 * p2, c3 * p3, c4 * N44)
    return b


@triton.jit
def basis_backward(x, y, z, v, DEGREE: tl.constexpr):
    """Gradient with respect to the direction, whose radial part is arbitrary; DEGREE > 0.

    d(x + i y)^m = m (x + i y)^(m - 1) d(x + i y), so v_c and v_s, of the real and imaginary part, go to x and y by one more product.
    """
    c2, s2, c3, s3, _, _ = azimuth(x, y)
    v_x = v[3] * -N10
    v_y = v[1] * -N10
    v_z = v[2] * N10
    if DEGREE >= 2:
        v_x += v[7] * z * -N21
        v_y += v[5] * z * -N21
        v_c2 = v[8] * N22
        v_s2 = v[4] * N22
        v_z += v[6] * z * (6.0 * N20) - (x * v[7] + y * v[5]) * N21
    if DEGREE >= 3:
        p1 = (5.0 * z * z - 1.0) * -N31
        v_x += v[13] * p1
        v_y += v[11] * p1
        v_c2 += v[14] * z * N32
        v_s2 += v[10] * z * N32
        v_c3 = v[15] * -N33
        v_s3 = v[9] * -N33
        v_z += v[12] * (15.0 * z * z - 3.0) * N30 - (x * v[13] + y * v[11]) * z * (10.0 * N31) + (c2 * v[14] + s2 * v[10]) * N32
    if DEGREE >= 4:
        zz = z * z
        p1 = (7.0 * zz - 3.0) * z * -N41
        p2 = (7.0 * zz - 1.0) * N42
        v_x += v[21] * p1 + 4.0 * N44 * (c3 * v[24] + s3 * v[16])
        v_y += v[19] * p1 + 4.0 * N44 * (c3 * v[16] - s3 * v[24])
        v_c2 += v[22] * p2
        v_s2 += v[18] * p2
        v_c3 += v[23] * z * -N43
        v_s3 += v[17] * z * -N43
        v_z += (v[20] * (140.0 * zz - 60.0) * z * N40 - (x * v[21] + y * v[19]) * (21.0 * zz - 3.0) * N41
                + (c2 * v[22] + s2 * v[18]) * z * (14.0 * N42) - (c3 * v[23] + s3 * v[17]) * N43)
    if DEGREE >= 3:
        v_x += 3.0 * (c2 * v_c3 + s2 * v_s3)
        v_y += 3.0 * (c2 * v_s3 - s2 * v_c3)
    if DEGREE >= 2:
        v_x += 2.0 * (x * v_c2 + y * v_s2)
        v_y += 2.0 * (x * v_s2 - y * v_c2)
    return v_x, v_y, v_z


@triton.jit
def direction(mean, centers, camera, wanted):
    """Unit direction from the camera centre and 1/distance; along z, and 0, where the mean is at the centre or not wanted."""
    x = mean[0] - tl.load(centers + camera * 3)
    y = mean[1] - tl.load(centers + camera * 3 + 1)
    z = mean[2] - tl.load(centers + camera * 3 + 2)
    square = x * x + y * y + z * z
    nowhere = (square == 0) | ~wanted
    inverse = tl.where(nowhere, 0.0, 1.0 / tl.sqrt(tl.where(nowhere, 1.0, square)))
    return (tl.where(nowhere, 0.0, x * inverse), tl.where(nowhere, 0.0, y * inverse), tl.where(nowhere, 1.0, z * inverse)), inverse


@triton.jit
def in_some_camera(mask, n, inside, N, C):
    """Whether a splat is wanted in any camera: if not, its coefficients are not even read."""
    seen = tl.load(mask + n, mask=inside, other=0)
    c = tl.full((), 1, tl.int64)
    while c < C:
        seen |= tl.load(mask + c * N + n, mask=inside, other=0)
        c += 1
    return seen


@triton.jit
def coefficient_rows(p, n, K: tl.constexpr, D: tl.constexpr, CHANNELS: tl.constexpr):
    """Pointers to the rows of splats in coeffs `[N, K, D]`, at this program's group of channels."""
    if CHANNELS == D:                   # no offset, or the compiler could not see that rows are aligned
        return p + n * (K * D)
    else:
        return p + n * (K * D) + tl.program_id(1) * CHANNELS


@triton.jit
def load_coefficients(p, wanted, USED: tl.constexpr, D: tl.constexpr, CHANNELS: tl.constexpr, CHUNK: tl.constexpr):
    """USED x CHANNELS coefficients; one run of memory if the group of channels is all of them."""
    if CHANNELS == D:
        return load_row(p, wanted, USED * D, CHUNK)
    else:
        v = ()
        for k in tl.static_range(USED):
            v = v + load_row(p + k * D, wanted, CHANNELS, CHUNK)
        return v


@Launcher
@triton.jit(do_not_specialize=["N", "C"])
def harmonics_fwd_kernel(means, centers, coeffs, mask, out, N, C, K: tl.constexpr, D: tl.constexpr, DEGREE: tl.constexpr,
                         CHANNELS: tl.constexpr, CHUNK: tl.constexpr, BLOCK: tl.constexpr):
    """out `[C, N, D]`, of one block of splats and one group of channels."""
    USED: tl.constexpr = (DEGREE + 1) * (DEGREE + 1)
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = n < N
    seen = in_some_camera(mask, n, inside, N, C)
    mean = load_row(means + n * 3, seen, 3, 1)
    f = load_coefficients(coefficient_rows(coeffs, n, K, D, CHANNELS), seen, USED, D, CHANNELS, CHUNK)
    camera = tl.full((), 0, tl.int64)
    while camera < C:
        wanted = tl.load(mask + camera * N + n, mask=inside, other=0)
        unit, _ = direction(mean, centers, camera, wanted)
        b = basis(unit[0], unit[1], unit[2], DEGREE)
        p = out + (camera * N + n) * D + tl.program_id(1) * CHANNELS
        for d in tl.static_range(CHANNELS):
            value = b[0] * f[d]
            for k in tl.static_range(1, USED):
                value += b[k] * f[k * CHANNELS + d]
            tl.store(p + d, tl.where(wanted, value, 0.0), mask=inside)
        camera += 1


@Launcher
@triton.jit(do_not_specialize=["N", "C"])
def harmonics_bwd_kernel(means, centers, coeffs, mask, v_out, v_means, v_coeffs, partial_centers, N, C, K: tl.constexpr, D: tl.constexpr,
                         DEGREE: tl.constexpr, CHANNELS: tl.constexpr, CHUNK: tl.constexpr, BLOCK: tl.constexpr):
    """Gradients of one block of splats and one group of channels: v_coeffs; v_means `[groups, N, 3]`; -v_centers, summed over the block.

    These sums `[groups x programs, C, 4]`, if there are such, and the groups, torch adds up: no atomics, the same bits in every run.
    """
    USED: tl.constexpr = (DEGREE + 1) * (DEGREE + 1)
    COUNT: tl.constexpr = USED * CHANNELS
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = n < N
    seen = in_some_camera(mask, n, inside, N, C)
    mean = load_row(means + n * 3, seen, 3, 1)
    rows = coefficient_rows(coeffs, n, K, D, CHANNELS)
    zero = tl.zeros_like(mean[0])
    v_f = (zero,) * COUNT
    v_mean = (zero, zero, zero)
    camera = tl.full((), 0, tl.int64)
    while camera < C:
        wanted = tl.load(mask + camera * N + n, mask=inside, other=0)
        unit, inverse = direction(mean, centers, camera, wanted)
        b = basis(unit[0], unit[1], unit[2], DEGREE)
        v = load_row(v_out + (camera * N + n) * D + tl.program_id(1) * CHANNELS, wanted, CHANNELS, 1)
        sums = v_f[0:0]
        for i in tl.static_range(COUNT):
            sums += (v_f[i] + b[i // CHANNELS] * v[i % CHANNELS],)
        v_f = sums
        if DEGREE > 0:
            # read again for each camera, from the cache, rather than held: as many registers as the sums would be too many
            f = load_coefficients(rows, wanted, USED, D, CHANNELS, CHUNK)
            v_b = f[0:0]
            for k in tl.static_range(USED):
                value = v[0] * f[k * CHANNELS]
                for d in tl.static_range(1, CHANNELS):
                    value += v[d] * f[k * CHANNELS + d]
                v_b += (value,)
            v_unit = basis_backward(unit[0], unit[1], unit[2], v_b, DEGREE)
            along = dot(unit, v_unit)
            some = v[0] != 0                            # else the gradient is 0, also where the coefficients are not finite
            for d in tl.static_range(1, CHANNELS):
                some |= v[d] != 0
            v_x = tl.where(some, (v_unit[0] - unit[0] * along) * inverse, 0.0)
            v_y = tl.where(some, (v_unit[1] - unit[1] * along) * inverse, 0.0)
            v_z = tl.where(some, (v_unit[2] - unit[2] * along) * inverse, 0.0)
            v_mean = (v_mean[0] + v_x, v_mean[1] + v_y, v_mean[2] + v_z)
            if partial_centers is not None:
                total = tl.sum(stack((v_x, v_y, v_z, zero), 4), 0)
                row = (tl.program_id(1) * tl.num_programs(0) + tl.program_id(0)).to(tl.int64) * C + camera
                tl.store(partial_centers + row * 4 + tl.arange(0, 4), total)
        camera += 1
    v_rows = coefficient_rows(v_coeffs, n, K, D, CHANNELS)
    if CHANNELS == D:
        PADDING: tl.constexpr = -COUNT % CHUNK          # zeros, for the first coefficients that are not used
        store_row(v_rows, v_f + (zero,) * PADDING, inside, COUNT + PADDING, CHUNK)
    else:
        for k in tl.static_range(USED):
            store_row(v_rows + k * D, v_f[k * CHANNELS:(k + 1) * CHANNELS], inside, CHANNELS, CHUNK)
    if DEGREE > 0:
        store_row(v_means + (tl.program_id(1).to(tl.int64) * N + n) * 3, v_mean, inside, 3, 1)


def harmonics(means: Tensor, centers: Tensor, coeffs: Tensor, degree: int, mask: Tensor) -> Tensor:
    """Launcher; see `tsplat_reference.harmonics`."""
    (C, N), (K, D) = mask.shape, coeffs.shape[1:]
    out = coeffs.new_empty(C, N, D)
    if out.numel() == 0:
        return out
    options = launch("harmonics")
    channels, chunk = _group(K, D, degree)
    harmonics_fwd_kernel[(ceil_div(N, options["BLOCK"]), D // channels)](
        means.contiguous(), centers.contiguous(), coeffs.contiguous(), mask.contiguous(), out, N, C, K=K, D=D, DEGREE=degree,
        CHANNELS=channels, CHUNK=chunk, **options)
    return out


def harmonics_backward(means: Tensor, centers: Tensor, coeffs: Tensor, degree: int, mask: Tensor, v_out: Tensor, cameras: bool = True
                       ) -> tuple[Tensor, Tensor, Tensor]:
    """Launcher; see `tsplat_reference.harmonics_backward`. Without `cameras` there is no gradient of centers: `[0, 3]`."""
    (C, N), (K, D) = mask.shape, coeffs.shape[1:]
    means, centers, coeffs = means.contiguous(), centers.contiguous(), coeffs.contiguous()
    no_centers = torch.zeros_like(centers) if cameras else centers.new_empty(0, 3)
    if v_out.numel() == 0:
        return torch.zeros_like(means), no_centers, torch.zeros_like(coeffs)
    options = launch("harmonics_backward")
    channels, chunk = _group(K, D, degree)
    programs, groups = ceil_div(N, options["BLOCK"]), D // channels
    v_coeffs = torch.empty_like(coeffs) if (degree + 1) ** 2 == K else torch.zeros_like(coeffs)
    v_means = means.new_empty(groups, N, 3)
    partial_centers = means.new_empty(groups * programs, C, 4) if cameras else None
    harmonics_bwd_kernel[(programs, groups)](
        means, centers, coeffs, mask.contiguous(), v_out.contiguous(), v_means, v_coeffs, partial_centers, N, C, K=K, D=D,
        DEGREE=degree, CHANNELS=channels, CHUNK=chunk, **options)
    if degree == 0:
        return torch.zeros_like(means), no_centers, v_coeffs
    v_centers = no_centers if partial_centers is None else -partial_centers.sum(0)[:, :3]
    return v_means[0] if groups == 1 else v_means.sum(0), v_centers, v_coeffs


def _group(K: int, D: int, degree: int) -> tuple[int, int]:
    """How many channels a program takes, a divisor of D, and how many numbers of a splat's row a load or store."""
    used = (degree + 1) ** 2
    channels = D if D <= 3 else next(c for c in (4, 3, 2, 1) if D % c == 0 and c * used <= HELD)
    return channels, math.gcd(4, K * D if channels == D else channels)
