"""Blending and its backward on a CPU: cache-sized blocks of tiles x splats x pixels, matrix products, in-place operations.

The splats of a tile are taken in chunks. Blocks of tiles that still have splats and light left go through one chunk together: the
polynomial of `footprint` gives log alpha as a matrix product, a running product gives the transmittance, and colours, their
gradients and the moments for the geometry are matrix products again. Between chunks a pixel keeps its light, the transmittance in
front of the next splat, and in the backward the rest: what is still to come, times the upstream gradient. Finished tiles drop out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from tsplat_reference import footprint
from tsplat_reference.binning import tile_counts
from tsplat_reference.blending import to_image, to_tiles
from tsplat_reference.constants import ALPHA_MIN, TRANSMITTANCE_MIN
from tsplat_reference.walk import Chunk, Memory, TileLists, empty_sums, products

R = TypeVar("R")

LOG2_ALPHA_MIN = math.log2(ALPHA_MIN)
"""Alpha is evaluated by exp2, which takes 0.4 times as long as exp, and no longer where the result is 0."""


@dataclass(frozen=True)
class _Scene:
    """The splats of all tiles, and what blending needs to know of them."""

    lists: TileLists
    records: Tensor         # [C N, RECORD], and the colours [C N, D + 1] unless they are shared; the last channel is 1, for alpha
    colors: Tensor | None   # [N, D + 1] if several cameras share them
    channels: int           # D + 1
    alpha_max: float
    drop_last: bool
    monomials: Tensor       # [6, P]
    exponents: Tensor       # [6, P]: the coefficients of log alpha times these are log2 alpha

    def run(self, function: Callable[[_Group], R], light: Tensor) -> Iterator[R]:
        """The results of `function` of groups of tiles, in an order that the number of threads does not change.

        `light` `[tiles, P]`, the transmittance, is what `function` updates at the tiles of its group: tiles without any are done.
        """
        return self.lists.run(lambda chunk: function(self.group(chunk)), lambda tiles, begin: _lit(light.index_select(0, tiles)), self.channels)

    def group(self, chunk: Chunk) -> _Group:
        """Records and colours of the splats of a chunk."""
        shape = chunk.padding.shape
        record = self.records.index_select(0, chunk.splats)                                 # a splat's numbers are beside each other in memory
        if self.colors is None:
            record, colors = record[:, :footprint.RECORD], record[:, footprint.RECORD:]
        else:
            colors = self.colors.index_select(0, chunk.splats % len(self.colors))
        record = torch.stack(record.unbind(-1)).view(-1, *shape)                            # in half the time of a transposed copy
        record[5].masked_fill_(chunk.padding, footprint.NOTHING)
        cx, cy = self.lists.centers(chunk.tiles, record.dtype)
        return _Group(chunk, record, cx[:, None] - record[0], cy[:, None] - record[1], colors.view(*shape, -1),
                      bool(record[5].amax() >= math.log(self.alpha_max)))


class _Group(NamedTuple):
    """G tiles with K splats each."""

    chunk: Chunk
    record: Tensor          # [RECORD, G, K]
    qx: Tensor              # [G, K], tile centre minus mean
    qy: Tensor
    colors: Tensor          # [G, K, D + 1]
    clamps: bool            # whether alpha can reach its clamp


def _scene(means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, ids: Tensor, offsets: Tensor, width: int, height: int,
           tile: int, alpha_max: float, drop_last: bool) -> _Scene:
    C, D = len(opacities), colors.shape[-1]
    tiles_x, tiles_y = tile_counts(width, height, tile)
    records = footprint.records(means2d.reshape(-1, 2), conics.reshape(-1, 3), opacities.flatten())
    table = [colors.reshape(-1, D), colors.new_ones(colors.shape[0] * colors.shape[1], 1)]      # here, not for each hit
    shared = len(colors) < C
    monomials = footprint.monomials(tile, means2d.dtype, means2d.device)
    return _Scene(TileLists(ids, offsets[:-1], offsets.diff(), (C, tiles_y, tiles_x), tile),
                  records if shared else torch.cat([records, *table], 1), torch.cat(table, 1) if shared else None, D + 1, alpha_max, drop_last,
                  monomials, monomials / math.log(2))


def _weights(scene: _Scene, coefficients: Tensor, clamp: bool, light: Tensor, alpha: Tensor, T: Tensor, transmit: Scan, odds: bool) -> Tensor:
    """Weights `[B, K, P]`, alpha times the transmittance in front. With `odds` they take the room of T, and that of alpha has alpha/(1 - alpha), 0
    beyond the end of a pixel; else they take the room of alpha.

    `light` `[B, P]` is the transmittance in front of the chunk, and behind it on return.
    """
    products(coefficients.mT, scene.exponents, out=alpha)
    torch.threshold_(alpha, LOG2_ALPHA_MIN, footprint.NOTHING)
    alpha.exp2_()
    if clamp:
        alpha.clamp_(max=scene.alpha_max)
    torch.sub(1, alpha, out=T)
    if odds:
        alpha.div_(T)
    transmit.run(torch.mul, light)
    behind = T[:, -1].clone()
    if behind.amin() <= TRANSMITTANCE_MIN:                  # else no pixel ends here
        if scene.drop_last:
            _keep_where(T, alpha)
        else:
            _keep_where(T[:, :-1], alpha[:, 1:])            # T in front of the others
            _keep_where(light, alpha[:, 0])
    if odds:
        weight = T.mul_(alpha)
    else:
        weight = alpha
        weight[:, 0].mul_(light)
        weight[:, 1:].mul_(T[:, :-1])
    light.copy_(behind)
    return weight


class Scan:
    """Running sums or products of x `[B, K, P]` from start `[B, P]`: out[:, k] = start op x[:, 0] op .. op x[:, k]; `out` `[B, K, P]` may be x.

    Of pairs, then of pairs of pairs, and back (Brent and Kung, 1982): twice the operations of torch.cumsum and cumprod, but these take one number
    after the other, which is 2 to 3 times as long. `other`, of another x and the same out, gives the views of what is done within out.
    """

    def __init__(self, x: Tensor, out: Tensor, other: Scan | None = None) -> None:
        self.first = x[:, 0], out[:, 0]
        self.steps: list[tuple[Tensor, Tensor, Tensor]] = []
        self.within: list[tuple[Tensor, Tensor, Tensor]] = []
        if x.shape[1] > 1:
            self.within = _steps(out[:, 1::2]) if other is None else other.within
            self.steps = [(x[:, 1], out[:, 0], out[:, 1]), (x[:, 3::2], x[:, 2:-1:2], out[:, 3::2]), *self.within,
                          (x[:, 2::2], out[:, 1:-1:2], out[:, 2::2])]

    def run(self, op: Callable[..., Tensor], start: Tensor) -> None:
        """With what is in x now."""
        x, out = self.first
        op(x, start, out=out)
        for a, b, c in self.steps:
            op(a, b, out=c)


def _steps(x: Tensor) -> list[tuple[Tensor, Tensor, Tensor]]:
    """In place, without a start. Which numbers are joined first does not depend on how many there are: padding changes no bit."""
    if x.shape[1] < 2:
        return []
    odd = x[:, 1::2]
    steps = [(odd, x[:, :-1:2], odd), *_steps(odd)]
    return steps if x.shape[1] == 2 else [*steps, (x[:, 2::2], x[:, 1:-1:2], x[:, 2::2])]


def _forward_room(alpha: Tensor, T: Tensor) -> tuple[Tensor, Tensor, Scan]:
    """A block's arrays, and the running product of T in place."""
    return alpha, T, Scan(T, T)


def _backward_room(odds: Tensor, T: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor, Scan, Scan]:
    """A block's arrays, the running product of T in place, and the running sum of v, in the room of T."""
    transmit = Scan(T, T)
    return odds, T, v, transmit, Scan(v, T, transmit)


def _keep_where(T: Tensor, x: Tensor) -> None:
    """Set x to 0 where T is at most the limit: a comparison and a mask take several times as long."""
    torch.ops.aten.threshold_backward.grad_input(x, T, TRANSMITTANCE_MIN, grad_input=x)


def blend_blocks(means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, backgrounds: Tensor | None, ids: Tensor,
                 offsets: Tensor, width: int, height: int, tile: int, alpha_max: float, drop_last: bool) -> tuple[Tensor, Tensor]:
    """As `blending.blend`, without autograd. Working memory beyond inputs and outputs: one number per pixel and channel, per splat its record
    and colours, and constants."""
    scene = _scene(means2d, conics, opacities, colors, ids, offsets, width, height, tile, alpha_max, drop_last)
    D = colors.shape[-1]
    light = _light(scene, width, height)
    image = light.new_zeros(len(light), D + 1, tile * tile)
    memory = Memory(scene.records, tile * tile, D + 1, 2, _forward_room)

    def blend_group(group: _Group) -> _Group:
        coefficients = footprint.coefficients(group.record, group.qx, group.qy)
        group_light = light.index_select(0, group.chunk.tiles)
        group_image = image.new_empty(len(group.chunk.tiles), D + 1, tile * tile)
        for rows, k, room in memory.blocks(group.chunk):
            weight = _weights(scene, coefficients[rows, :, :k], group.clamps, group_light[rows], *room, odds=False)
            products(group.colors[rows, :k].mT, weight, out=group_image[rows])
        light.index_copy_(0, group.chunk.tiles, group_light)                                # no other group has these tiles
        image.index_add_(0, group.chunk.tiles, group_image)
        return group

    for _ in scene.run(blend_group, light):
        pass
    if backgrounds is not None:                             # here, where a channel's pixels are beside each other
        views = image.view(len(backgrounds), -1, *image.shape[1:])
        views[:, :, :D].addcmul_(1 - views[:, :, D:], backgrounds[:, None, :, None])
    rendered, alphas = (to_image(channels, scene.lists.shape, width, height) for channels in (image[:, :D], image[:, D:]))
    return rendered, alphas[..., 0]


def blend_blocks_backward(means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, backgrounds: Tensor | None, ids: Tensor,
                          offsets: Tensor, image: Tensor, alphas: Tensor, v_image: Tensor, v_alphas: Tensor | None, width: int, height: int,
                          tile: int, alpha_max: float, drop_last: bool, absgrad: bool) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Closed-form gradients of `blend` with respect to means2d, conics, opacities and colors. (That of the background is the sum of
    (1 - alpha) dL/dimage.)

    With L the loss, g_i = <c_i - background, dL/dimage> + dL/dalpha and the rest R_i = sum_{j > i} w_j g_j:
    dL/dlog alpha_i = w_i g_i - alpha_i/(1 - alpha_i) R_i.
    Front to back, R starts as the sum over all splats, which is known from the image, and loses one term at each.

    The fifth result is the absolute gradient `[C, N, 2]`: sum over pixels of |dL/dmean2d| per axis (AbsGS); empty unless asked for.
    """
    scene = _scene(means2d, conics, opacities, colors, ids, offsets, width, height, tile, alpha_max, drop_last)
    C, N, D = *opacities.shape, colors.shape[-1]
    v_alphas = torch.zeros_like(alphas) if v_alphas is None else v_alphas
    if backgrounds is None:
        behind = torch.zeros_like(v_alphas)
    else:
        behind = torch.einsum("chwd,cd->chw", v_image, backgrounds)                         # <background, dL/dimage>
    upstream = torch.cat([to_tiles(v_image, tile), to_tiles((v_alphas - behind)[..., None], tile)], 1)      # [tiles, D + 1, P]
    rest = (image * v_image) @ image.new_ones(D) + alphas * v_alphas - behind               # a sum over the last axis takes 4 times as long
    rest = to_tiles(rest[..., None], tile)[:, 0]
    light = _light(scene, width, height)
    shared = scene.colors is not None
    sums = empty_sums(6 if shared else 6 + D, C * N, colors)
    v_colors = empty_sums(D, N, colors) if shared else sums[6:]
    v_abs = empty_sums(2, C * N if absgrad else 0, means2d)
    highest = float(scene.records.new_tensor(alpha_max).div_(1 - scene.records.new_tensor(alpha_max)))     # rounded as odds are
    memory = Memory(scene.records, tile * tile, D + 1, 3, _backward_room)

    def backward_group(group: _Group) -> tuple[Tensor, Tensor, list[Tensor]]:
        coefficients = footprint.coefficients(group.record, group.qx, group.qy)
        slopes = footprint.mean_slopes(coefficients) if absgrad else ()
        group_light, group_rest, group_upstream = (v.index_select(0, group.chunk.tiles) for v in (light, rest, upstream))
        shape = group.chunk.padding.shape
        moments, results = colors.new_zeros(shape[0], 6, shape[1]), colors.new_empty(6 + D, *shape)
        results[6:] = 0
        sums_abs = [torch.zeros_like(group.qx) for _ in slopes]
        for rows, k, (odds, T, v, transmit, add_up) in memory.blocks(group.chunk):
            weight = _weights(scene, coefficients[rows, :, :k], group.clamps, group_light[rows], odds, T, transmit, odds=True)
            products(group.colors[rows, :k], group_upstream[rows], out=v)                   # g
            results[6:, rows, :k] = products(group_upstream[rows], weight.mT)[:, :D].transpose(0, 1)  # 4 rows take less time than 3
            v.mul_(weight)
            add_up.run(torch.add, -group_rest[rows])                                        # to T: minus the rest behind each splat
            torch.neg(T[:, -1], out=group_rest[rows])
            v.addcmul_(odds, T)                                                             # dL/dlog alpha
            if group.clamps:    # v = 0 where the odds are 0, as it is already, or those of alpha_max
                torch.ops.aten.hardtanh_backward.grad_input(v, odds, 0.0, highest, grad_input=v)
            moments[rows, :, :k] = products(scene.monomials, v.mT)                          # a strided `out` is slow
            for slope, sum_abs in zip(slopes, sums_abs, strict=True):
                products(slope[rows, :, :k].mT, scene.monomials[:3], out=T)
                sum_abs[rows, :k] = T.mul_(v).abs_().sum(2)
        light.index_copy_(0, group.chunk.tiles, group_light)
        rest.index_copy_(0, group.chunk.tiles, group_rest)
        footprint.moments_about_mean(group.record, group.qx, group.qy, moments, results[:6])
        return group.chunk.splats, results.flatten(1), sums_abs

    for splats, results, sums_abs in scene.run(backward_group, light):
        sums.index_add_(1, splats, results[:len(sums)])
        if shared:
            v_colors.index_add_(1, splats % N, results[6:])
        for v, sum_abs in zip(v_abs, sums_abs, strict=False):         # nothing to add without absgrad
            v.index_add_(0, splats, sum_abs.flatten())
    v_means2d, v_conics, v_opacities = footprint.records_backward(scene.records, opacities.flatten(), sums[:6])
    return (v_means2d.view_as(means2d), v_conics.view_as(conics), v_opacities.view_as(opacities),
            v_colors.T.clone(memory_format=torch.contiguous_format).view(colors.shape), v_abs.T.contiguous().view(C, -1, 2))


def _lit(light: Tensor) -> Tensor:
    """Which tiles have a pixel that is not finished."""
    return light.amax(1) > TRANSMITTANCE_MIN


def _light(scene: _Scene, width: int, height: int) -> Tensor:
    """Light `[tiles, P]` at the start: 1, and 0 at the pixels of the last tiles that are beyond the border."""
    return to_tiles(scene.records.new_ones(1, height, width, 1), scene.lists.tile)[:, 0].repeat(scene.lists.shape[0], 1)
