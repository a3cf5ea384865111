"""The lists of all tiles, walked front to back in chunks, for many tiles at a time and on all cores, in memory that has a bound."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import torch
from torch import Tensor

from tsplat_reference.parallel import workers

R = TypeVar("R")
V = TypeVar("V")

CHUNK = 64
"""Splats of a tile per chunk. Finished pixels end with it, so more would waste work; fewer would pay the calls more often."""
LANES = 4
"""Chunks have a multiple of this many splats: with others, matrix products of float64 round in another way, and the alphas of a tile would have other
bits beside other tiles."""
BLOCK = 1 << 19
"""Pairs in a block: its buffers of this size, 6 MB in float32 where there are three, are the working set of a thread. Smaller ones fit closer
caches, but then the calls cost more than that gains (measured from 2^15 to 2^20), the more so with several threads, which wait for each
other in Python."""
GROUP = 1 << 16
"""Hits of a group of blocks, whose small operations (gathering, coefficients, scattering) are done together, by one thread: about 60
numbers per hit, 16 MB in float32. With more than 8 channels a group has fewer hits."""
ALONE = 1 << 18
"""Hits of a group that has all tiles, up to which there is only one: images of 512x512 in tiles of 8. Its calls are fewer, and OpenMP spreads each
over the cores: 0.65 to 0.95 times as long as groups and workers, for 70k to 700k hits on two cores. Up to 64 MB in float32."""
PLANES = 1 << 18
"""Splats of which a plane, 1 MB in float32, stays in a cache."""
SHAPES = 64
"""Shapes of blocks whose views are kept, of some 50 kB each."""
FEW = 1 << 13
"""Hits of a group below which its chunks grow, up to twofold each time: the calls for a few tiles with long lists cost more than their work."""
WORTH_WORKERS = 1 << 15
"""Hits from which worker threads gain, if there are several groups. (Measured with groups of 1,024 tiles on images of any size: at 70k, two threads
took 0.9 times as long as without workers, at 9k 1.3 times.)"""


class Chunk(NamedTuple):
    """Up to K splats of each of G tiles.

    tiles: `[G]`. splats: `[G K]`, int64, as index_add is 20 times slower with int32. lengths: how many each tile has, in descending order.
    padding: `[G, K]`, what is beyond that.
    """

    tiles: Tensor
    splats: Tensor
    lengths: list[int]
    padding: Tensor


@dataclass(frozen=True)
class TileLists:
    """The splats of all tiles: ids int32 `[M]`, starts and counts int64 `[tiles]`, shape (C, tiles_y, tiles_x), and the side of a tile."""

    ids: Tensor
    starts: Tensor
    counts: Tensor
    shape: tuple[int, int, int]
    tile: int

    def run(self, function: Callable[[Chunk], R], alive: Callable[[Tensor, int], Tensor | None], channels: int, grow: bool = True
            ) -> Iterator[R]:
        """The results of `function` of all that is to do, in an order that the number of threads does not change. (Bits may: where a group is
        alone, OpenMP splits operations, and torch.exp2 of float32 rounds the last numbers of a part in another way.)

        `alive(tiles, begin)` says which tiles need their splats from `begin` on (None: all). Groups of tiles go front to back beside each
        other, each at its own pace: no core waits for the slowest group of a round. Without `grow`, all chunks begin at multiples of CHUNK.
        """
        tiles = self.counts.sort(descending=True, stable=True).indices[:int((self.counts > 0).sum())]     # longest lists first
        most, size = (max(1, hits * 9 // (CHUNK * max(9, channels))) for hits in (ALONE, GROUP))
        size = len(tiles) if 0 < len(tiles) <= most else size
        worth = len(tiles) > size and int(self.counts.sum()) >= WORTH_WORKERS
        strands = [map(function, self._chunks(some, alive, grow)) for some in torch.split(tiles, size)]
        with workers(worth) as ordered_map:
            yield from (result for result in ordered_map(_next, strands, repeat=True) if result is not None)

    def centers(self, tiles: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """X and y `[G]` of the centres of tiles, in pixels."""
        return ((tiles % self.shape[2] * self.tile).to(dtype) + self.tile / 2,
                (tiles // self.shape[2] % self.shape[1] * self.tile).to(dtype) + self.tile / 2)

    def _chunks(self, tiles: Tensor, alive: Callable[[Tensor, int], Tensor | None], grow: bool) -> Iterator[Chunk]:
        """The splats of a group of tiles, front to back; tiles that have or need no more drop out."""
        counts = self.counts[tiles]
        begin = 0
        while len(tiles):
            few = min(begin, FEW // len(tiles), BLOCK // self.tile**2) if grow else 0
            k = min(max(CHUNK, few // LANES * LANES), _whole(int(counts[0]) - begin))
            at = (self.starts[tiles] + begin)[:, None] + torch.arange(k)                    # [G, K]
            lengths = (counts - begin).clamp_(max=k)
            yield Chunk(tiles, self.ids.index_select(0, at.clamp_(max=len(self.ids) - 1).flatten()).long(), lengths.tolist(),
                        torch.arange(k) >= lengths[:, None])
            begin += k
            left, needed = counts > begin, alive(tiles, begin)
            live = (left if needed is None else left & needed).nonzero().squeeze(-1)
            tiles, counts = tiles.index_select(0, live), counts.index_select(0, live)


class Memory(Generic[V]):
    """Scratch memory for blocks, which the blocks of a group, and then other groups, reuse: so many arrays `[B, K, P]`, and what `views` makes of
    them, once for all blocks of one shape, as slicing takes as long as the operations of a small block."""

    def __init__(self, like: Tensor, pixels: int, channels: int, buffers: int, views: Callable[..., V]) -> None:
        self.like, self.pixels, self.channels, self.views = like, pixels, channels, views
        self.shape = buffers, max(BLOCK, pixels * CHUNK)
        self.free: list[tuple[Tensor, dict[tuple[int, int], V]]] = []

    def blocks(self, chunk: Chunk) -> Iterator[tuple[slice, int, V]]:
        """Blocks of the tiles of a chunk: their rows, how many splats of each tile are all that are not padding, and the views."""
        try:                                                # not asked first: another thread may take it in between
            memory, known = self.free.pop()
        except IndexError:
            memory, known = self.like.new_empty(self.shape), {}
        lengths, longest = chunk.lengths, chunk.padding.shape[1]
        i = 0
        while i < len(lengths):
            k = min(_whole(lengths[i]), longest)
            b = min(max(1, BLOCK // (self.pixels * max(k, self.channels))), len(lengths) - i)   # many channels: they set the working set
            if (b, k) not in known:
                if len(known) >= SHAPES:
                    known.clear()
                known[b, k] = self.views(*memory[:, :b * k * self.pixels].view(-1, b, k, self.pixels).unbind(0))
            yield slice(i, i + b), k, known[b, k]
            i += b
        self.free.append((memory, known))


def arrays(*room: Tensor) -> tuple[Tensor, ...]:
    """The views of a block that needs no others."""
    return room


def _whole(count: int) -> int:
    """The next multiple of LANES."""
    return -(-count // LANES) * LANES


def products(a: Tensor, b: Tensor, out: Tensor | None = None) -> Tensor:
    """Matrix products a @ b of `[B, m, n]` (or `[m, n]` for all alike) and `[B, n, p]` (likewise), with the same bits on one and on two threads: of
    a single pair of matrices, torch.bmm calls another routine, which splits its sums. So a second one stands beside it. (With more threads than
    matrices, MKL splits these, too, and the last bits of float64 may differ.)
    """
    count = max(len(m) for m in (a, b) if m.ndim == 3)
    a, b = (m.expand(count, -1, -1) for m in (a, b))
    if count > 1:
        return torch.bmm(a, b) if out is None else torch.bmm(a, b, out=out)
    single = torch.bmm(a.expand(2, -1, -1), b.expand(2, -1, -1))[:1]
    return single if out is None else out.copy_(single)


def empty_sums(numbers: int, splats: int, like: Tensor) -> Tensor:
    """Zeros `[numbers, splats]`, to add to at some splats. Few are stored as planes: these stay in a cache, and no two threads write to one cache
    line, which made the sums of 10k splats take 2 to 10 times as long. Of many, the numbers of each are together: one cache miss for all."""
    return like.new_zeros(numbers, splats) if splats <= PLANES else like.new_zeros(splats, numbers).T


def _next(steps: Iterator[R]) -> R | None:
    return next(steps, None)
