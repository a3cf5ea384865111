"""`Ranks`: the processes of one fit, of which each holds some of the splats and renders one photo of a step. One process is the case of one rank."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from typing import TYPE_CHECKING, TypeVar

import torch
from torch import Tensor

if TYPE_CHECKING:
    from torch.distributed import ProcessGroup  # some builds of torch have none

T = TypeVar("T")
CHUNK = 1 << 20        # rows that each rank sends at a time to be collected: bounds what the first has on its device besides its own


class Ranks:
    """What a fit needs of its processes. All ranks make the same calls in the same order; with one rank nothing is communicated.

    Splats are in blocks, as `tsplat.distributed` counts them: those of rank 0, of rank 1, ...

    Args:
        group: None for one process.
        device: where this process computes.

    Attributes:
        group: None if it has one rank: that is as no group.
        count, rank: how many there are, and which this is.

    Raises:
        TypeError, ValueError: `group` is none, or its backend does not move tensors of `device`.
    """

    def __init__(self, group: ProcessGroup | None = None, device: str | torch.device = "cpu") -> None:
        self.count, self.rank, self.group, self.device = 1, 0, None, torch.device(device)
        if group is None:
            return
        from tsplat.distributed.collectives import check_device, check_group
        if check_group(group) > 1:
            check_device(group, self.device)
            self.count, self.rank, self.group = group.size(), group.rank(), group

    def numbers(self, *mine: float) -> list[tuple[float, ...]]:
        """The numbers that each rank gave."""
        if self.group is None:
            return [mine]
        from tsplat.distributed.collectives import all_gather
        return [tuple(row) for row in all_gather(torch.tensor(mine, dtype=torch.float64, device=self.device), self.group).tolist()]

    def sizes(self, mine: int) -> list[int]:
        """The number that each rank gave."""
        return [int(size) for size, in self.numbers(mine)]

    def total(self, mine: int) -> int:
        """The sum of the numbers that the ranks gave."""
        return sum(self.sizes(mine))

    def add(self, values: Tensor) -> Tensor:
        """The sum of small tensors of one shape, with the same bits on all ranks."""
        if self.group is None:
            return values
        from tsplat.distributed.collectives import all_gather
        return all_gather(values.detach(), self.group).sum(0)

    def objects(self, mine: T) -> list[T]:
        """What each rank gave, by pickle."""
        if self.group is None:
            return [mine]
        everyone = [mine] * self.count
        torch.distributed.all_gather_object(everyone, mine, group=self.group)
        return everyone

    def gather(self, values: Tensor) -> tuple[Tensor, slice]:
        """`[N, ...]` of the splats of all ranks, and which of them are those of this rank, from `[n, ...]` of its own.

        For scores, which decide between all splats: 8 bytes for each on every rank, and 16 more where they are sorted, for a moment, as a step
        has 8 for each and each camera where density control looks on.
        """
        if self.group is None:
            return values, slice(0, len(values))
        sizes = self.sizes(len(values))
        first = sum(sizes[:self.rank])
        everyone = self._exchange(torch.cat([values.detach()] * self.count), [len(values)] * self.count, sizes)
        return everyone, slice(first, first + len(values))

    def moved(self, rows: Tensor, old: list[int], new: list[int]) -> Tensor:
        """Rows `[new[rank], ...]`, from `[old[rank], ...]`: those of all ranks stay in their order, and the borders between ranks move."""
        if self.group is None:
            return rows
        return self._exchange(rows.detach(), _overlaps(old, self.rank, new), _overlaps(new, self.rank, old))

    def collected(self, rows: Tensor) -> Tensor:
        """Rows of all ranks `[N, ...]` on the CPU, on rank 0; `[0, ...]` elsewhere."""
        if self.group is None:
            return rows.detach().cpu()
        sizes, parts = self.sizes(len(rows)), []
        for start in range(0, max(sizes), CHUNK):
            each = [max(0, min(CHUNK, size - start)) for size in sizes]
            chunk = rows.detach()[start:start + CHUNK]
            come = self._exchange(chunk, [len(chunk)] + [0] * (self.count - 1), each if self.rank == 0 else [0] * self.count)
            parts.append(torch.split(come.cpu(), each if self.rank == 0 else [0] * self.count))
        return torch.cat([chunks[rank] for rank in range(self.count) for chunks in parts] or [rows.detach().cpu()])

    def local(self, generator: torch.Generator) -> torch.Generator:
        """A source of random numbers for the splats of this rank, from one that is the same on all ranks, and stays so."""
        if self.group is None:
            return generator
        seed = int(torch.randint(2**62, (), generator=generator))
        return torch.Generator().manual_seed(seed + self.rank)

    @contextmanager
    def agreement(self) -> Iterator[None]:
        """Where the block, which must not communicate, raises on one rank, it raises on all."""
        error: Exception | None = None
        try:
            yield
        except Exception as raised:
            if self.group is None:
                raise
            error = raised
        if any(failed for failed, in self.numbers(error is not None)):
            raise next(e for e in self.objects(error) if e is not None)

    def _exchange(self, rows: Tensor, send: list[int], receive: list[int]) -> Tensor:
        from tsplat.distributed.collectives import all_to_all
        assert self.group is not None
        return all_to_all(rows, send, receive, self.group)


ALONE = Ranks()


def even(total: int, ranks: int) -> list[int]:
    """Sizes of so many blocks, which differ by at most 1."""
    ends = [total * rank // ranks for rank in range(ranks + 1)]
    return [end - begin for begin, end in pairwise(ends)]


def _overlaps(sizes: list[int], rank: int, others: list[int]) -> list[int]:
    """How many rows block `rank` of one division has in common with each block of another."""
    begin = sum(sizes[:rank])
    end, first, common = begin + sizes[rank], 0, []
    for size in others:
        common.append(max(0, min(end, first + size) - max(begin, first)))
        first += size
    return common


def own_part(indices: Tensor, own: slice) -> Tensor:
    """Of splats of all ranks, int64 `[M]`, those in the block `own`, counted from its begin."""
    first, end = int(own.start), int(own.stop)
    return indices[(indices >= first) & (indices < end)] - first
