"""Device functions for projection and SH: rows of memory as small vectors, and the camera models with their backward.

The camera models are the twin of `tsplat_reference.camera`, for one camera and a block of splats, one per thread. A vector is a tuple of
scalars or blocks, a matrix a tuple of rows.
"""

import triton
import triton.language as tl

SERIES_BELOW = tl.constexpr(0.05)       # (r/z)^2 under which the fisheye uses its power series


@triton.jit
def stack(v, WIDTH: tl.constexpr):
    """The first WIDTH (a power of 2) of the blocks v as one block `[BLOCK, WIDTH]`; each thread keeps its row."""
    if WIDTH == 1:
        return tl.expand_dims(v[0], 1)
    else:
        both = tl.join(stack(v[0:WIDTH:2], WIDTH // 2), stack(v[1:WIDTH:2], WIDTH // 2))
        return tl.reshape(both, (both.shape[0], WIDTH))


@triton.jit
def unstack(rows):
    """The inverse of `stack`, a tuple."""
    BLOCK: tl.constexpr = rows.shape[0]
    HALF: tl.constexpr = rows.shape[1] // 2
    if HALF == 0:
        return (tl.reshape(rows, (BLOCK,)),)
    else:
        left, right = tl.split(tl.permute(tl.reshape(rows, (BLOCK, 2, HALF)), (0, 2, 1)))
        return unstack(left) + unstack(right)


@triton.jit
def load_row(p, wanted, LENGTH: tl.constexpr, CHUNK: tl.constexpr, OTHER: tl.constexpr = 0.0):
    """p[0], p[1], ... p[LENGTH - 1] and on to a multiple of CHUNK, with p a block of pointers; OTHER where not wanted.

    With CHUNK 4, where rows are aligned to 16 bytes, a thread takes its row with 16-byte loads and no shuffles.
    """
    v = ()
    for i in tl.static_range(0, LENGTH, CHUNK):
        v = v + unstack(tl.load(p[:, None] + (i + tl.arange(0, CHUNK))[None, :], mask=wanted[:, None], other=OTHER))
    return v


@triton.jit
def store_row(p, v, wanted, LENGTH: tl.constexpr, CHUNK: tl.constexpr):
    """The inverse of `load_row`; LENGTH is a multiple of CHUNK."""
    for i in tl.static_range(0, LENGTH, CHUNK):
        tl.store(p[:, None] + (i + tl.arange(0, CHUNK))[None, :], stack(v[i:i + CHUNK], CHUNK), mask=wanted[:, None])


@triton.jit
def dot(a, b):
    """Inner product of 3-vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@triton.jit
def transform(A, v):
    """A v of a 3 x 3 matrix."""
    return dot(A[0], v), dot(A[1], v), dot(A[2], v)


@triton.jit
def transform_transposed(A, v):
    """A^T v of a 3 x 3 matrix; v is a column, or a row that is multiplied by A."""
    return (A[0][0] * v[0] + A[1][0] * v[1] + A[2][0] * v[2], A[0][1] * v[0] + A[1][1] * v[1] + A[2][1] * v[2],
            A[0][2] * v[0] + A[1][2] * v[1] + A[2][2] * v[2])


@triton.jit
def load_camera(viewmats, Ks, camera):
    """W, t and (fx, fy, cx, cy) of one camera (int64)."""
    p = viewmats + camera * 16
    k = Ks + camera * 9
    W = ((tl.load(p), tl.load(p + 1), tl.load(p + 2)), (tl.load(p + 4), tl.load(p + 5), tl.load(p + 6)),
         (tl.load(p + 8), tl.load(p + 9), tl.load(p + 10)))
    return W, (tl.load(p + 3), tl.load(p + 7), tl.load(p + 11)), (tl.load(k), tl.load(k + 4), tl.load(k + 2), tl.load(k + 5))


@triton.jit
def to_camera(mean, W, t):
    """p = W mean + t."""
    x, y, z = transform(W, mean)
    return x + t[0], y + t[1], z + t[2]


@triton.jit
def or_ahead(valid, p):
    """The points, with (0, 0, 1) for those that are not valid, so that nothing that is computed of them is infinite."""
    return tl.where(valid, p[0], 0.0), tl.where(valid, p[1], 0.0), tl.where(valid, p[2], 1.0)


@triton.jit
def project_point(p, intrinsics, width, height, MODEL: tl.constexpr, MARGIN: tl.constexpr):
    """Pixel (u, v) and the rows of the Jacobian, at points with z > 0 (any z for the orthographic model)."""
    x, y, z = p
    fx, fy, cx, cy = intrinsics
    zero = tl.zeros_like(x)
    if MODEL == "pinhole":
        u, ux, uz = pinhole_axis(x, z, fx, cx, width, MARGIN)
        v, vy, vz = pinhole_axis(y, z, fy, cy, height, MARGIN)
        return u, v, (ux, zero, uz), (zero, vy, vz)
    elif MODEL == "orthographic":
        return fx * x + cx, fy * y + cy, (zero + fx, zero, zero), (zero, zero + fy, zero)
    else:
        s, k, _, w = fisheye_terms(x, y, z)
        xy_k = x * y * k
        return (fx * x * s + cx, fy * y * s + cy, (fx * (s + x * x * k), fx * xy_k, -fx * x * w),
                (fy * xy_k, fy * (s + y * y * k), -fy * y * w))


@triton.jit
def project_point_backward(p, intrinsics, width, height, v_u, v_v, v_J0, v_J1, MODEL: tl.constexpr, MARGIN: tl.constexpr):
    """Gradients with respect to the point and to (fx, fy, cx, cy)."""
    x, y, z = p
    fx, fy, cx, cy = intrinsics
    if MODEL == "pinhole":
        v_x, v_z0, v_fx, v_cx = pinhole_axis_backward(x, z, fx, cx, width, v_u, v_J0[0], v_J0[2], MARGIN)
        v_y, v_z1, v_fy, v_cy = pinhole_axis_backward(y, z, fy, cy, height, v_v, v_J1[1], v_J1[2], MARGIN)
        return (v_x, v_y, v_z0 + v_z1), (v_fx, v_fy, v_cx, v_cy)
    elif MODEL == "orthographic":
        return (fx * v_u, fy * v_v, tl.zeros_like(x)), (v_u * x + v_J0[0], v_v * y + v_J1[1], v_u, v_v)
    else:
        s, k, m, w = fisheye_terms(x, y, z)
        xx = x * x
        xy = x * y
        yy = y * y
        v_fx = v_u * x * s + v_J0[0] * (s + xx * k) + v_J0[1] * xy * k - v_J0[2] * x * w
        v_fy = v_v * y * s + v_J1[1] * (s + yy * k) + v_J1[0] * xy * k - v_J1[2] * y * w
        a = fx * v_u
        b = fx * v_J0[0]
        d = fx * v_J0[2]
        e = fy * v_v
        f = fy * v_J1[1]
        h = fy * v_J1[2]
        cross = fx * v_J0[1] + fy * v_J1[0]
        v_s = a * x + b + e * y + f
        v_k = b * xx + cross * xy + f * yy
        v_w = -d * x - h * y
        # ds = k (x dx + y dy) - w dz,  dk = m (x dx + y dy) + 2 w^2 dz,  dw = -2 w^2 (x dx + y dy + z dz)
        ww2 = 2.0 * w * w
        radial = v_s * k + v_k * m - v_w * ww2
        v_x = a * s + 2.0 * b * x * k + cross * y * k - d * w + radial * x
        v_y = e * s + 2.0 * f * y * k + cross * x * k - h * w + radial * y
        v_z = v_k * ww2 - v_s * w - v_w * ww2 * z
        return (v_x, v_y, v_z), (v_fx, v_fy, v_u, v_v)


@triton.jit
def frustum(f, c, size, MARGIN: tl.constexpr):
    """The range of x/z to which the pinhole Jacobian clamps: the frustum, widened on each side."""
    size = size.to(f.dtype)
    margin = size * (0.5 * MARGIN)
    return -(c + margin) / f, (size - c + margin) / f


@triton.jit
def pinhole_axis(x, z, f, c, size, MARGIN: tl.constexpr):
    """u = f x/z + c, du/dx = f/z and du/dz = -f clamp(x/z)/z."""
    low, high = frustum(f, c, size, MARGIN)
    t = x / z
    f_z = f / z
    return f * t + c, f_z, -f_z * tl.minimum(tl.maximum(t, low), high)


@triton.jit
def pinhole_axis_backward(x, z, f, c, size, v_u, v_jx, v_jz, MARGIN: tl.constexpr):
    """Gradients with respect to x, z, f and c; the clamp passes its gradient on to the intrinsics that set the frustum."""
    low, high = frustum(f, c, size, MARGIN)
    t = x / z
    f_z = f / z
    clamped = tl.minimum(tl.maximum(t, low), high)
    v_clamped = -f_z * v_jz
    v_limit = tl.where((t < low) | (t > high), v_clamped, 0.0)
    v_t = f * v_u + v_clamped - v_limit
    v_f_z = v_jx - clamped * v_jz
    # low = -(c + margin)/f, high = (size - c + margin)/f: d/df = -limit/f, d/dc = -1/f
    v_f = v_u * t + v_f_z / z - v_limit * clamped / f
    return v_t / z, -(v_t * t + v_f_z * f_z) / z, v_f, v_u - v_limit / f


@triton.jit
def fisheye_terms(x, y, z):
    """s = theta/r, k = (ds/dr)/r, m = (dk/dr)/r and w = 1/(r^2 + z^2), with r^2 = x^2 + y^2 and theta = atan2(r, z); z > 0.

    Triton has no arctangent. One series, atan(q)/q = sum (-q^2)^n / (2n + 1), serves everywhere: near the axis with q = r/z, where the
    closed forms of k and m cancel and need series of their own; elsewhere with q = tan(theta/8) <= 0.199, by three half-angle formulas.
    Thus q^2 <= 0.05, and 12 terms leave 1e-17 in s, 3e-16 in k and 6e-15 in m (7 terms, in float32: 5e-11, 7e-10 and 1e-8); each half
    angle adds a rounding or two.
    """
    TERMS: tl.constexpr = 12 if x.dtype == tl.float64 else 7
    r2 = x * x + y * y
    near_axis = r2 < (z * z) * SERIES_BELOW             # in this order: the interpreter of Triton 3.7 cannot multiply a constexpr by a tensor
    off_r2 = tl.where(near_axis, 1.0, r2)
    w = 1.0 / (r2 + z * z)
    iz = 1.0 / z
    iz2 = iz * iz

    r = tl.sqrt(off_r2)
    half = r / (tl.sqrt(off_r2 + z * z) + z)                # tan(theta/2)
    quarter = half / (1.0 + tl.sqrt(1.0 + half * half))
    eighth = quarter / (1.0 + tl.sqrt(1.0 + quarter * quarter))

    t = tl.where(near_axis, r2 * iz2, eighth * eighth)
    s = tl.zeros_like(t)
    k = tl.zeros_like(t)
    m = tl.zeros_like(t)
    for n in tl.static_range(TERMS - 1, -1, -1):
        s = s * t + (1 - n % 2 * 2) / (2 * n + 1)
        k = k * t - (1 - n % 2 * 2) * 2 * (n + 1) / (2 * n + 3)
        m = m * t + (1 - n % 2 * 2) * 4 * (n + 1) * (n + 2) / (2 * n + 5)
    s = s * tl.where(near_axis, iz, 8.0 * eighth / r)
    k = tl.where(near_axis, k * (iz2 * iz), (z * w - s) / off_r2)
    m = tl.where(near_axis, m * (iz2 * iz2 * iz), (-2.0 * z * (w * w) - 3.0 * k) / off_r2)
    return s, k, m, w
