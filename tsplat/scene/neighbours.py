"""Exact nearest neighbours in pure torch: a balanced k-d tree built by sorting, searched leaf against leaf."""

from __future__ import annotations

import math

import torch
from torch import Tensor

LEAF_SIZE = 32                # points in a leaf of the tree, at most
CHUNK_ELEMENTS = 1 << 22      # distances held at once: bounds the memory


def nearest_squared_distances(points: Tensor, k: int) -> Tensor:
    """Squared distances from each point to its `k` nearest others, exact and ascending.

    Args:
        points: `[N, 3]`, finite. Points at one place are neighbours at distance 0.
        k: how many neighbours; fewer come back where N is too small.

    Returns:
        `[N, min(k, N - 1)]`, of the dtype of `points`.
    """
    n = len(points)
    k = min(k, n - 1)
    if k < 1:
        return points.new_zeros(n, 0)
    slots = _leaves(points)                                           # [M, B] indices into points, -1 where empty
    filled = slots >= 0
    leaves = points[slots.clamp(min=0)]                               # [M, B, 3]; an empty slot repeats point 0
    low = leaves.masked_fill(~filled[..., None], torch.inf).amin(1)   # [M, 3]
    high = leaves.masked_fill(~filled[..., None], -torch.inf).amax(1)
    reach = _distances(leaves, leaves, slots, slots)                  # [M, B, B]
    own = reach.topk(k, dim=2, largest=False).values[..., -1]         # [M, B] k-th nearest within the leaf
    bound = own.masked_fill(~filled, 0).amax(1)                       # [M] no neighbour of the leaf is farther than this

    found = points.new_empty(n, k)
    size = slots.shape[1]
    for start in range(0, len(slots), max(1, CHUNK_ELEMENTS // len(slots))):
        here = slice(start, start + max(1, CHUNK_ELEMENTS // len(slots)))
        gap = torch.maximum(low - high[here, None], low[here, None] - high).clamp(min=0)      # [m, M, 3] between boxes
        near = gap.square().sum(-1) < bound[here, None]               # [m, M] leaves that may hold a nearer neighbour
        near.diagonal(start).fill_(True)
        counts, order = near.sum(1).sort(descending=True)
        while len(order):                                             # leaves with like counts go together
            width = int(counts[0])
            many = max(1, CHUNK_ELEMENTS // (size * size * width))
            rows, order, counts = order[:many], order[many:], counts[many:]
            others = near[rows].byte().topk(width, dim=1).indices     # [r, width] leaves, filled up with needless ones
            queries = slots[rows + start]                             # [r, B]
            distances = _distances(leaves[rows + start], leaves[others].flatten(1, 2), queries, slots[others].flatten(1))
            nearest = distances.topk(k, dim=2, largest=False).values  # [r, B, k]
            found[queries[queries >= 0]] = nearest[queries >= 0]
    return found


def _leaves(points: Tensor) -> Tensor:
    """Split at the median of the widest axis until leaves hold at most `LEAF_SIZE`: `[M, B]` indices, -1 where empty."""
    n = len(points)
    depth = max(0, math.ceil(math.log2(n / LEAF_SIZE)))
    size = math.ceil(n / 2**depth)
    index = torch.arange(size * 2**depth, device=points.device)
    repeated = torch.where(index < n, index, index - n)               # the few empty slots stand at real points
    for level in range(depth):
        nodes = repeated[index].view(2**level, -1)                    # [nodes, points]
        place = points[nodes]                                         # [nodes, points, 3]
        axis = (place.amax(1) - place.amin(1)).argmax(1)              # [nodes]
        along = place.gather(2, axis[:, None, None].expand(-1, place.shape[1], 1)).squeeze(2)
        index = index.view(2**level, -1).gather(1, along.argsort(1)).flatten()
    return torch.where(index < n, index, -1).view(2**depth, size)


def _distances(a: Tensor, b: Tensor, a_slots: Tensor, b_slots: Tensor) -> Tensor:
    """Squared distances `[..., A, B]`; infinite to an empty slot and from a point to itself."""
    total = (a[..., :, None, 0] - b[..., None, :, 0]).square_()
    for axis in (1, 2):
        total += (a[..., :, None, axis] - b[..., None, :, axis]).square_()
    return total.masked_fill_((b_slots[..., None, :] < 0) | (a_slots[..., :, None] == b_slots[..., None, :]), torch.inf)
