"""Spheres on a CPU: blocks of tiles that fit in a cache, in-place operations, a softmax that goes along (online), gradients in closed form.

With c the centre over R and m = (x, y, 1) the ray, t = (delta/R)^2 = |c x m|^2/|m|^2 is over a tile a polynomial of degree two in the pixel's
position about the tile's centre, over |m|^2; the distance along the ray to the point closest to the centre is one of degree one, over |m|.
So both are matrix products at all pixels, of monomials that are weighted for the tile, and so are the sums that the backward needs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from tsplat_reference import footprint
from tsplat_reference.binning import tile_counts
from tsplat_reference.blending import to_image, to_tiles
from tsplat_reference.camera import join_intrinsics, split_intrinsics
from tsplat_reference.spheres import SphereImages
from tsplat_reference.walk import Chunk, Memory, TileLists, arrays, empty_sums, products

LOG2_E = 1 / math.log(2)
MISSED = 1e30
"""|c x m|^2 of padding: more than any |m|^2, so that no ray hits it."""


class SphereGradients(NamedTuple):
    """Gradients, shaped as the inputs of `blend_spheres`."""

    centers: Tensor
    radii: Tensor
    opacities: Tensor
    features: Tensor
    backgrounds: Tensor
    gamma: Tensor
    Ks: Tensor


@dataclass(frozen=True)
class SphereScene:
    """What is the same for all tiles."""

    lists: TileLists
    records: Tensor         # [C N, 5]: x, y, z, R, o
    features: Tensor        # [C N or N, D]
    shared: int             # N if all cameras share the features, else 0
    gamma: float
    background_depth: float
    intrinsics: Tensor      # [C, 4]: 1/fx, 1/fy, cx, cy
    orthographic: bool
    near: float
    far: float
    chord: bool
    monomials: Tensor       # [6, P]

    @property
    def slope(self) -> float:
        """Derivative of z/gamma by D."""
        return -1 / (self.gamma * (self.far - self.near))

    @staticmethod
    def of(centers: Tensor, radii: Tensor, opacities: Tensor, features: Tensor, gamma: Tensor, Ks: Tensor, ids: Tensor, starts: Tensor,
           counts: Tensor, width: int, height: int, tile: int, model: str, near: float, far: float, background_depth: float, chord: bool
           ) -> SphereScene:
        """From the arguments of `blend_spheres`."""
        C, N = centers.shape[:2]
        tiles_x, tiles_y = tile_counts(width, height, tile)
        records = torch.cat([centers, radii.expand(C, -1)[..., None], opacities.expand(C, -1)[..., None]], -1).view(C * N, 5)
        fx, fy, cx, cy = split_intrinsics(Ks)
        return SphereScene(TileLists(ids, starts, counts, (C, tiles_y, tiles_x), tile), records, features.reshape(-1, features.shape[-1]),
                           N if len(features) < C else 0, float(gamma), background_depth, torch.cat([1 / fx, 1 / fy, cx, cy], 1),
                           model == "orthographic", near, far, chord and model == "pinhole", footprint.monomials(tile, centers.dtype, centers.device))

    def group(self, chunk: Chunk) -> SphereGroup:
        """Geometry of the spheres and the rays of a chunk."""
        lists, shape = self.lists, chunk.padding.shape
        record = torch.stack(self.records.index_select(0, chunk.splats).unbind(-1)).view(5, *shape)        # in half the time of a transposed copy
        kx, ky, cx, cy = self.intrinsics[chunk.tiles // (lists.shape[1] * lists.shape[2])].unbind(1)
        tile_x, tile_y = lists.centers(chunk.tiles, record.dtype)
        qx, qy = tile_x - cx, tile_y - cy
        rays = Rays(qx, qy, kx, ky, (qx * kx)[:, None], (qy * ky)[:, None])
        rows = chunk.splats % self.shared if self.shared else chunk.splats
        features = self.features.index_select(0, rows).view(*shape, -1)
        x, y, z, R, o = record
        k1 = o * (self.slope * LOG2_E)
        k0 = (o * (1 + self.near / (self.far - self.near)) - self.background_depth) * (LOG2_E / self.gamma)
        if self.orthographic:
            mono2, mono1, distance = self.monomials, self.monomials[:3], z
            beyond = bool((z - R).amin() < self.near) or bool(z.amax() > self.far)
        else:
            norm2 = self._norm2(rays)
            mono2, mono1 = self.monomials / norm2[:, None], self.monomials[:3] * norm2.rsqrt()[:, None]
            distance = (x * x + y * y + z * z).sqrt()
            beyond = bool((distance - R).amin() < self.near) or bool(distance.amax() > self.far) or bool((z - R).amin() < 0)
        quadratic, linear = self._coefficients(record, rays)
        quadratic.masked_fill_(chunk.padding[:, None], 0.0)
        quadratic[:, 0].masked_fill_(chunk.padding, MISSED)
        return SphereGroup(chunk, rays, rows, record, features, quadratic, linear, mono2, mono1, distance, k0, k1, beyond)

    def _norm2(self, rays: Rays) -> Tensor:
        """|m|^2 `[G, P]`."""
        _, X, Y = self.monomials[:3]
        mx, my = rays.mx + X * rays.kx[:, None], rays.my + Y * rays.ky[:, None]
        norm2: Tensor = mx * mx + my * my + 1
        return norm2

    def _coefficients(self, record: Tensor, rays: Rays) -> tuple[Tensor, Tensor]:
        """Coefficients `[G, 6, K]` of t |m|^2 and `[G, 3, K]` of the distance times |m|."""
        px, py, pz, ax, ay, bx, by = self._product(record, rays)
        x, y, z, _, _ = record
        quadratic = [px * px + py * py + pz * pz, 2 * (px * ax - pz * bx), 2 * (py * ay + pz * by), ax * ax + bx * bx, -2 * bx * by,
                     ay * ay + by * by]
        kx, ky = rays.kx[:, None], rays.ky[:, None]
        zero = torch.zeros_like(z)
        linear = [z, zero, zero] if self.orthographic else [x * rays.mx + y * rays.my + z, x * kx, y * ky]
        return torch.stack(quadratic, 1), torch.stack(linear, 1)

    def _product(self, record: Tensor, rays: Rays) -> tuple[Tensor, ...]:
        """Vector product of ray and centre over R: (px + ax X, py + ay Y, pz + by Y - bx X)."""
        x, y, z, R, _ = record
        r = 1 / R
        kx, ky = rays.kx[:, None], rays.ky[:, None]
        if self.orthographic:
            zero = torch.zeros_like(r)
            return (rays.mx - x) * r, (rays.my - y) * r, zero, r * kx, r * ky, zero, zero
        return ((z * rays.mx - x) * r, (z * rays.my - y) * r, (x * rays.my - y * rays.mx) * r, z * r * kx, z * r * ky, y * r * kx,
                x * r * ky)

    def coefficients_backward(self, group: SphereGroup, m2: Tensor, m1: Tensor, v_norm2: Tensor | None) -> tuple[Tensor, Tensor]:
        """Gradients `[4, G, K]` of x, y, z and R, and `[G, 4]` of fx, fy, cx and cy.

        m2 `[G, 6, K]` and m1 `[G, 3, K]`: sums over pixels of dL/dt and dL/da, times the weighted monomials. v_norm2 `[G, P]`: dL/d|m|^2.
        """
        x, y, z, R, _ = group.record
        rays, r = group.rays, 1 / R
        kx, ky, mx, my = rays.kx[:, None], rays.ky[:, None], rays.mx, rays.my
        px, py, pz, ax, ay, bx, by = self._product(group.record, rays)
        s, sx, sy, sxx, sxy, syy = m2.unbind(1)
        v_px, v_ax = 2 * (px * s + ax * sx), 2 * (px * sx + ax * sxx)
        v_py, v_ay = 2 * (py * s + ay * sy), 2 * (py * sy + ay * syy)
        d, dx, dy = m1.unbind(1)
        if self.orthographic:
            v_r = v_px * px * R + v_py * py * R + v_ax * kx + v_ay * ky
            v_mx, v_my, v_kx, v_ky = v_px * r, v_py * r, v_ax * r, v_ay * r
            v = [-v_mx, -v_my, d, -v_r * r * r]
        else:
            v_pz = 2 * (pz * s + by * sy - bx * sx)
            v_bx, v_by = -2 * (pz * sx + by * sxy - bx * sxx), 2 * (pz * sy + by * syy - bx * sxy)
            v_x = my * v_pz - v_px + ky * v_by                                              # of x/R, and so on
            v_y = -mx * v_pz - v_py + kx * v_bx
            v_z = mx * v_px + my * v_py + kx * v_ax + ky * v_ay
            v = [v_x * r + mx * d + kx * dx, v_y * r + my * d + ky * dy, v_z * r + d, -(v_x * x + v_y * y + v_z * z) * r * r]
            v_mx, v_my = (z * v_px - y * v_pz) * r + x * d, (z * v_py + x * v_pz) * r + y * d
            v_kx, v_ky = (z * v_ax + y * v_bx) * r + x * dx, (z * v_ay + x * v_by) * r + y * dy
        v_rays = [w.sum(1) for w in (v_mx, v_my, v_kx, v_ky)]
        if v_norm2 is not None:
            _, X, Y = self.monomials[:3]
            v_x, v_y = 2 * (mx + X * kx) * v_norm2, 2 * (my + Y * ky) * v_norm2
            v_rays = [a + b for a, b in zip(v_rays, (v_x.sum(1), v_y.sum(1), v_x @ X, v_y @ Y), strict=True)]
        v_mx, v_my, v_kx, v_ky = v_rays
        v_kx, v_ky = v_kx + rays.qx * v_mx, v_ky + rays.qy * v_my
        return torch.stack(v), torch.stack([-v_kx * rays.kx**2, -v_ky * rays.ky**2, -v_mx * rays.kx, -v_my * rays.ky], 1)


class Rays(NamedTuple):
    """Of the pixels of G tiles. qx, qy: `[G]`, tile centre minus principal point. kx, ky: 1/fx, 1/fy. mx, my: `[G, 1]`, ray of the centre."""

    qx: Tensor
    qy: Tensor
    kx: Tensor
    ky: Tensor
    mx: Tensor
    my: Tensor


class SphereGroup(NamedTuple):
    """G tiles with K spheres each."""

    chunk: Chunk
    rays: Rays
    rows: Tensor            # [G K], of the features
    record: Tensor          # [5, G, K]
    features: Tensor        # [G, K, D]
    quadratic: Tensor       # [G, 6, K]
    linear: Tensor          # [G, 3, K]
    mono2: Tensor           # [G, 6, P], over |m|^2, or [6, P]
    mono1: Tensor           # [G, 3, P], over |m|, or [3, P]
    distance: Tensor        # [G, K], of the centre
    k0: Tensor              # [G, K]: log2(e) (o z - eps)/gamma = k0 + k1 D (exp2 takes 0.4 times as long as exp)
    k1: Tensor
    beyond: bool            # whether some hit may be out of the range of depths

    def part(self, rows: slice, k: int) -> SphereGroup:
        """Some of its tiles, and their first k spheres."""
        mono2, mono1 = (m if m.ndim == 2 else m[rows] for m in (self.mono2, self.mono1))
        return self._replace(record=self.record[:, rows, :k], features=self.features[rows, :k], quadratic=self.quadratic[rows, :, :k],
                             linear=self.linear[rows, :, :k], mono2=mono2, mono1=mono1, distance=self.distance[rows, :k],
                             k0=self.k0[rows, :k], k1=self.k1[rows, :k])


def fill_hits(scene: SphereScene, g: SphereGroup, s: Tensor, h: Tensor, d: Tensor, D: Tensor) -> Tensor:
    """Fill in, `[B, K, P]`: s = delta/R, h = half the length within the sphere over R, d = 1 - s (0 if missed), and D.

    Returns:
        with `chord`, 2/(1 + cos) of the angle between ray and centre, else nothing `[0]`.
    """
    R = g.record[3][..., None]
    products(g.quadratic.mT, g.mono2, out=s)
    s.clamp_(0.0, 1.0)
    products(g.linear.mT, g.mono1, out=D)
    torch.sub(1, s, out=h)
    h.sqrt_()
    factor = s.new_empty(0)
    if scene.chord:
        factor = 2 / (1 + D / g.distance[..., None].clamp_min(torch.finfo(D.dtype).tiny))
        s.mul_(factor).clamp_(max=1.0)
    D.addcmul_(h, R, value=-1)
    s.sqrt_()
    torch.sub(1, s, out=d)
    if g.beyond:
        d.masked_fill_((D < scene.near) | (D > scene.far), 0.0)
    return factor


def blend_sphere_blocks(centers: Tensor, radii: Tensor, opacities: Tensor, features: Tensor, backgrounds: Tensor, gamma: Tensor, Ks: Tensor,
                  ids: Tensor, offsets: Tensor, width: int, height: int, tile: int, model: str, near: float, far: float,
                  background_depth: float, chord: bool, depth: bool, tolerance: float) -> SphereImages:
    """As `blend_spheres`, without autograd. Working memory beyond inputs and outputs: some numbers per pixel and channel, and constants.

    A tile ends when the weights of all spheres that are left together are at most `tolerance` at each of its pixels: from the n spheres
    left, of which none is nearer than that which comes next, n o exp(o z/gamma) is the most, with o the largest opacity, at least 1. All terms
    are relative to that of the background.
    """
    scene = SphereScene.of(centers, radii, opacities, features, gamma, Ks, ids, offsets[:-1], offsets.diff(), width, height, tile, model, near,
                           far, background_depth, chord)
    lists, D = scene.lists, features.shape[-1]
    pixels, tiles = tile * tile, len(lists.counts)
    peak, total = centers.new_zeros(tiles, pixels), centers.new_ones(tiles, pixels)
    background = backgrounds.repeat_interleave(lists.shape[1] * lists.shape[2], 0)[..., None]
    image = torch.cat([background.expand(-1, -1, pixels), centers.new_zeros(tiles, int(depth), pixels)], 1)
    used = lists.counts.clone()
    memory = Memory(centers, pixels, D + 1, 5, arrays)
    nearest = scene.records[:, 2] if scene.orthographic else torch.linalg.vector_norm(scene.records[:, :3], dim=1)
    nearest = nearest - scene.records[:, 3]
    largest = max(1.0, float(opacities.max())) if opacities.numel() else 1.0
    ends = tolerance > 0 and bool((opacities < torch.inf).all())                            # else there is no largest

    def alive(some: Tensor, begin: int) -> Tensor | None:
        if not ends:
            return None
        counts = lists.counts[some]
        first = ids[(lists.starts[some] + begin).clamp_(max=len(ids) - 1)].long()
        z = 1 - ((nearest[first] - near) / (far - near)).clamp_(0, 1)
        left = (counts - begin).clamp(min=1).log2() + math.log2(largest) + (largest * z - background_depth) * (LOG2_E / scene.gamma)
        live = left > math.log2(tolerance) + (peak[some] + total[some].log2()).amin(1)
        used[some[(counts > begin) & ~live]] = begin                                        # no other group has these tiles
        return live

    def blend(chunk: Chunk) -> Chunk:
        group = scene.group(chunk)
        was, sums, images = (v.index_select(0, chunk.tiles) for v in (peak, total, image))
        for rows, k, (s, h, d, depths, e) in memory.blocks(chunk):
            g = group.part(rows, k)
            fill_hits(scene, g, s, h, d, depths)
            torch.addcmul(g.k0[..., None], g.k1[..., None], depths, out=e)
            e.masked_fill_(d <= 0, -torch.inf)
            now = torch.maximum(was[rows], e.amax(1))
            e.sub_(now[:, None]).exp2_().mul_(d.mul_(g.record[4][..., None]))
            shrink = (was[rows] - now).exp2_()
            was[rows] = now
            sums[rows] = sums[rows] * shrink + e.sum(1)
            images[rows] *= shrink[:, None]
            images[rows, :D] += products(g.features.mT, e)
            if depth:
                images[rows, D] += e.mul_(depths).sum(1)
        for full, mine in ((peak, was), (total, sums), (image, images)):
            full.index_copy_(0, chunk.tiles, mine)
        return chunk

    for _ in lists.run(blend, alive, D + 1, grow=not ends):      # an end that does not depend on what else is rendered
        pass
    image = torch.cat([image / total[:, None], (peak + total.log2())[:, None] / LOG2_E], 1)
    color, z, logsumexp = (to_image(x, lists.shape, width, height) for x in (image[:, :D], image[:, D:D + 1], image[:, -1:]))
    return SphereImages(color, z[..., 0] if depth else z.new_zeros(len(z), 0, width), logsumexp[..., 0], used.to(torch.int32))


def softmax_gradient(images: SphereImages, v_image: Tensor, v_depth: Tensor | None, v_logsumexp: Tensor | None) -> Tensor:
    """What the gradients of all terms of a pixel's softmax have in common `[C, H, W]`: with g_i = <f_i, dL/dimage> + D_i dL/ddepth, the
    derivative of L by the logarithm of a term (that of the background, too) is its weight times (g_i + this)."""
    common = -(images.image * v_image).sum(-1)
    if v_depth is not None:
        common = common - images.depth * v_depth
    return common if v_logsumexp is None else common + v_logsumexp


def background_gradients(backgrounds: Tensor, gamma: Tensor, logsumexp: Tensor, v_image: Tensor, v_logsumexp: Tensor | None, common: Tensor,
                         background_depth: float, cut: bool) -> tuple[Tensor, Tensor]:
    """Gradients of the backgrounds, and what is left of that of gamma without the spheres'; `common` is `softmax_gradient`.

    That of gamma is -1/gamma times the sum over the terms of derivative by the term's logarithm, times that logarithm. These are up to 1/gamma,
    and the derivatives are as large with either sign: they add up to `v_logsumexp`. So all logarithms are taken relative to that of the sum, and
    nothing large cancels. But if hits are `cut`, for which there is no such sum, as they are.
    """
    weight = (-logsumexp).exp()
    behind = (v_image * backgrounds[:, None, None]).sum(-1)
    rest = -weight * (behind + common) if v_logsumexp is None else v_logsumexp - weight * (behind + common)
    relative = background_depth / gamma if cut else -logsumexp
    return (v_image * weight[..., None]).sum((1, 2)), (rest * relative).sum() / gamma


def blend_sphere_blocks_backward(centers: Tensor, radii: Tensor, opacities: Tensor, features: Tensor, backgrounds: Tensor, gamma: Tensor,
                                 Ks: Tensor, ids: Tensor, offsets: Tensor, cutoff: Tensor | None, images: SphereImages, v_image: Tensor,
                                 v_depth: Tensor | None, v_logsumexp: Tensor | None, width: int, height: int, tile: int, model: str,
                                 near: float, far: float, background_depth: float, chord: bool, intrinsics: bool) -> SphereGradients:
    """Closed-form gradients of `blend_spheres`.

    A term of the softmax is o d exp(o z/gamma). All is computed from e = exp(o z/gamma - logsumexp) by products alone, so that o = 0, d = 0
    and rays through a centre are nothing special.

    Args:
        images: what `blend_spheres` returned.
        v_image, v_depth, v_logsumexp: gradients of these, None for zeros.
        intrinsics: whether the gradient of Ks is wanted; zeros if not.
    """
    scene = SphereScene.of(centers, radii, opacities, features, gamma, Ks, ids, offsets[:-1], images.used.long(), width, height, tile, model, near,
                           far, background_depth, chord)
    lists, (C, N), D = scene.lists, centers.shape[:2], features.shape[-1]
    common = softmax_gradient(images, v_image, v_depth, v_logsumexp)
    v_backgrounds, v_gamma = background_gradients(backgrounds, gamma, images.logsumexp, v_image, v_logsumexp, common, background_depth,
                                                 cutoff is not None)
    planes = [v_image, common[..., None], images.logsumexp[..., None] * LOG2_E]
    planes += [] if v_depth is None else [v_depth[..., None]]
    planes += [] if cutoff is None else [cutoff[..., None]]
    upstream = to_tiles(torch.cat(planes, -1), tile)                                        # [tiles, D + 2.., P]
    memory = Memory(centers, tile * tile, D + 1, 8, arrays)
    most = -math.log2(torch.finfo(centers.dtype).tiny)                                      # of e, where o or d is next to nothing
    least = math.sqrt(torch.finfo(centers.dtype).eps) / 2       # of s: below, a ray goes through the centre as far as its rounding tells

    def backward(chunk: Chunk) -> tuple[SphereGroup, Tensor, Tensor, Tensor, Tensor]:
        group = scene.group(chunk)
        G, K = chunk.padding.shape
        ups = upstream.index_select(0, chunk.tiles)
        m2, m1, v_features = (centers.new_zeros(G, n, K) for n in (6, 3, D))
        sums = centers.new_zeros(5, G, K)
        v_norm2 = centers.new_empty(G, tile * tile) if intrinsics and not scene.orthographic else None
        for rows, k, (s, h, d, depths, e, v, x, log_e) in memory.blocks(chunk):
            g, up = group.part(rows, k), ups[rows]
            R, o = g.record[3][..., None], g.record[4][..., None]
            factor = fill_hits(scene, g, s, h, d, depths)
            torch.addcmul(g.k0[..., None], g.k1[..., None], depths, out=log_e)
            torch.exp2(log_e.sub_(up[:, D + 1, None]).clamp_(max=most), out=e)
            e.masked_fill_(d <= 0, 0.0)
            if cutoff is not None:
                e.masked_fill_(depths > up[:, -1, None], 0.0)
            torch.mul(e, d, out=x)
            x.mul_(o)                                                                       # w
            v_features[rows, :, :k] = products(up[:, :D], x.mT)
            products(g.features, up[:, :D], out=v)
            if v_depth is not None:
                v.addcmul_(depths, up[:, D + 2, None])
            v.add_(up[:, D, None]).mul_(e)                                                  # (g + softmax_gradient) e
            torch.mul(v, d, out=x)
            torch.sum(x, 2, out=sums[0, rows, :k])
            sums[1, rows, :k] = torch.mul(x, depths).sum(2)
            sums[4, rows, :k] = torch.mul(x, log_e).sum(2)
            v_s = (v * o).neg_()                                                            # d = 1 - s
            along = v.mul_(o * (o * scene.slope))                                           # dL/dD over d
            if v_depth is not None:
                along.addcmul_(e.mul_(o), up[:, D + 2, None])
            torch.mul(along, d, out=x)                                                      # dL/dD
            sums[2, rows, :k] = -torch.mul(x, h).sum(2)                                     # D = a - R h
            # dL/dt: h = sqrt(1 - t), and d/h = h/(1 + s) loses nothing at the outline (with chord, h is larger and division safe)
            v_t = along.mul_(d).div_(h.clamp(min=least)) if scene.chord else along.mul_(h).div_(s + 1)
            v_t.mul_(0.5 * R)
            v_s.div_(s.clamp_(min=least).mul_(2))
            t = 1 - h * h
            if scene.chord:                                                                 # s^2 = t factor, factor = 2/(1 + a/distance)
                v_t.addcmul_(v_s, factor)
                v_factor = v_s.mul_(t).mul_(factor).mul_(factor).div_(2 * g.distance[..., None])
                x.sub_(v_factor)
                sums[3, rows, :k] = (v_factor.mul_(depths + R * h) / g.distance[..., None]).sum(2)
            else:
                v_t.add_(v_s)
            m2[rows, :, :k] = products(g.mono2, v_t.mT)
            m1[rows, :, :k] = products(g.mono1, x.mT)
            if v_norm2 is not None:
                v_norm2[rows] = -(v_t.mul_(t) + x.mul_(depths.addcmul_(h, R)).mul_(0.5)).sum(1)
        x0, x1, v_R, v_distance, x_log = sums
        xz = (1 + near / (far - near)) * x0 - x1 / (far - near)                             # sum of x z
        if v_norm2 is not None:
            v_norm2 /= scene._norm2(group.rays)
        v_geometry, v_K = scene.coefficients_backward(group, m2, m1, v_norm2)
        v_geometry[3] += v_R
        if scene.chord:
            v_geometry[:3] += group.record[:3] * (v_distance / group.distance)
        o = group.record[4]
        v_o = x0 + o * xz / scene.gamma
        v_gamma = -(o * (x_log / LOG2_E if cutoff is None else o * xz / scene.gamma)).sum() / scene.gamma     # see `background_gradients`
        return group, torch.cat([v_geometry, v_o[None]]), v_features, v_gamma, v_K

    v_records, v_table = empty_sums(5, C * N, centers), empty_sums(D, len(scene.features), centers)
    v_Ks = centers.new_zeros(C, 4)
    for group, v_record, v_features, v_g, v_K in lists.run(backward, lambda tiles, begin: None, D + 1):
        v_records.index_add_(1, group.chunk.splats, v_record.flatten(1))
        v_table.index_add_(1, group.rows, v_features.transpose(0, 1).reshape(D, -1))
        v_gamma += v_g
        v_Ks.index_add_(0, group.chunk.tiles // (lists.shape[1] * lists.shape[2]), v_K)
    v_records = v_records.view(5, C, N)
    v_radii, v_opacities = (v if len(x) == C else v.sum(0, keepdim=True) for v, x in ((v_records[3], radii), (v_records[4], opacities)))
    return SphereGradients(v_records[:3].permute(1, 2, 0), v_radii, v_opacities, v_table.T.reshape(features.shape), v_backgrounds, v_gamma,
                           join_intrinsics(*v_Ks.T[..., None]))
