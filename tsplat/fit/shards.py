"""The state of a fit in shards: which of it has a row per splat, how that is saved by many processes, and how it moves between them."""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from tsplat.fit.ranks import Ranks, even

UNEVEN = 1.1
"""Largest over mean number of splats of a rank, from which splats move: all ranks wait for that with the most."""
SHARDED = "gaussians", "adam", "control"     # what has rows: the tensors in these with a dimension; not Adam's count of steps, which has none


def map_rows(saved: dict[str, Any], change: Callable[[str, Tensor], Tensor]) -> dict[str, Any]:
    """A state (`FitState.state_dict`) with `change(name, rows)` in place of each tensor with a row per splat, always in the same order."""
    def mapped(name: str, value: Any) -> Any:
        if isinstance(value, dict):
            return {key: mapped(f"{name}/{key}", item) for key, item in value.items()}
        return change(name, value) if isinstance(value, Tensor) and value.ndim else value

    return {key: mapped(key, value) if key in SHARDED else value for key, value in saved.items()}


def moves(sizes: list[int]) -> bool:
    """Whether ranks with so many splats are too uneven, and can be made less so."""
    return max(sizes) * len(sizes) > UNEVEN * sum(sizes) and sizes != even(sum(sizes), len(sizes))


def save_rows(path: Path, saved: dict[str, Any], ranks: Ranks) -> tuple[dict[str, Any], dict[str, Any]]:
    """Write the rows of all ranks to a new folder beside `path`, by `torch.distributed.checkpoint`: a tensor for each name and rank.

    Returns:
        The state with no rows, and what `load_rows` has to know of them.

    Raises:
        OSError: on all ranks, if one of them cannot write.
    """
    from torch.distributed.checkpoint.api import CheckpointException
    from torch.distributed.checkpoint.state_dict_saver import save

    folder = ranks.objects(next(f for f in folders(path) if not f.exists()) if ranks.rank == 0 else path)[0]
    rows: dict[str, Any] = {}

    def take(name: str, tensor: Tensor) -> Tensor:
        rows[f"{name}/{ranks.rank}"] = tensor
        return tensor.new_empty(0, *tensor.shape[1:])        # not tensor[:0], with which all of it would be saved

    empty = map_rows(saved, take)
    sizes = ranks.sizes(len(next(iter(rows.values()))))
    try:
        save(rows, checkpoint_id=folder, process_group=ranks.group)
    except CheckpointException as error:                     # which is no Exception
        raise OSError(f"{folder}: cannot be written; {_reason(error)}") from None
    return empty, {"folder": folder.name, "sizes": sizes}


def load_rows(path: Path, saved: dict[str, Any], ranks: Ranks) -> dict[str, Any]:
    """The state with this rank's rows, from the content of a checkpoint `path`, of any number of ranks.

    As many ranks as saved it have what they had; others are even. A rank reads all that those had of whose splats it takes some.

    Raises:
        ValueError: the folder of the rows is not what it was.
    """
    if "shards" not in saved:
        total = len(next(iter(saved["state"]["gaussians"].values())))
        sizes = even(total, ranks.count)
        begin = sum(sizes[:ranks.rank])
        return saved["state"] if ranks.count == 1 else map_rows(saved["state"], lambda _, rows: rows[begin:begin + sizes[ranks.rank]].clone())

    from torch.distributed.checkpoint.api import CheckpointException
    from torch.distributed.checkpoint.state_dict_loader import load

    old: list[int] = saved["shards"]["sizes"]
    new = old if len(old) == ranks.count else even(sum(old), ranks.count)
    begin = sum(new[:ranks.rank])
    end, parts, first = begin + new[ranks.rank], [], 0                   # parts: rank that saved it, and which of its rows
    for rank, size in enumerate(old):
        parts.append((rank, slice(max(0, begin - first), max(0, min(size, end - first)))))
        first += size
    parts = [(rank, part) for rank, part in parts if part.start < part.stop] or [(0, slice(0, 0))]
    pieces: dict[str, Any] = {}

    def ask(name: str, empty: Tensor) -> Tensor:
        pieces.update({f"{name}/{rank}": empty.new_empty(old[rank], *empty.shape[1:]) for rank, _ in parts})
        return empty

    folder = path.with_name(saved["shards"]["folder"])
    map_rows(saved["state"], ask)
    if not (folder / ".metadata").exists():                  # of which torch would print how it looked for it
        raise ValueError(f"{folder}: expected the splats of the checkpoint {path.name}; the folder is not there, or not whole")
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="torch.distributed is")       # that each process reads alone
            load(pieces, checkpoint_id=folder, no_dist=True)
    except CheckpointException as error:
        raise ValueError(f"{folder}: expected the splats of the checkpoint {path.name}; {_reason(error)}") from None
    return map_rows(saved["state"], lambda name, _: torch.cat([pieces[f"{name}/{rank}"][part] for rank, part in parts]))


def folders(path: Path) -> list[Path]:
    """The two folders that the rows of a checkpoint `path` can be in: while one is written, the other is whole."""
    return [path.with_name(f"{path.name}.{i}") for i in range(2)]


def remove_others(path: Path, saved: dict[str, Any] | None) -> None:
    """Remove the folders that are not of the checkpoint `saved`: of an older one, or one that was never finished."""
    keep = (saved or {}).get("shards", {}).get("folder")
    for folder in folders(path):
        if folder.name != keep:
            shutil.rmtree(folder, ignore_errors=True)


def _reason(error: Any) -> str:
    """One line of what went wrong on the first rank where something did, from a `CheckpointException`."""
    rank, (cause, _) = min(error.failures.items(), key=lambda failure: int(failure[0]))
    return f"rank {rank}: " + (str(cause).partition("\n")[0] or type(cause).__name__)
