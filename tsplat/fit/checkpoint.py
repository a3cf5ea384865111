"""Checkpoints: files from which a fit goes on as if it had never stopped, written whole or not at all.

Of one process it is one file. Of several, each writes the rows of its splats to a folder beside that file, by `torch.distributed.checkpoint`; the
file has the rest, and names the folder. As it takes the place of the old one when the folder is whole, there is a whole checkpoint at any moment.
"""

from __future__ import annotations

import os
import pickle
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import torch

from tsplat.fit.config import FitConfig
from tsplat.fit.ranks import ALONE, Ranks
from tsplat.fit.shards import load_rows, remove_others, save_rows
from tsplat.fit.state import FitState
from tsplat.scene import Capture
from tsplat.scene.files import replacing

FORMAT = "tsplat fit 2"


def save_checkpoint(path: Path, state: FitState, config: FitConfig, capture: Capture) -> None:
    """Write `path`, on all ranks of the state; an older file stays until the new one is on the disk.

    Raises:
        OSError: it cannot be written (a full disk); the older file stays as it was.
    """
    saved: dict[str, Any] = {"format": FORMAT, "state": state.state_dict(), "config": asdict(config), "photos": _photos(capture)}
    if state.ranks.count > 1:
        saved["state"], saved["shards"] = save_rows(path, saved["state"], state.ranks)
    with state.ranks.agreement():
        if state.ranks.rank == 0:
            _write(path, saved)
            remove_others(path, saved)


def _write(path: Path, saved: dict[str, Any]) -> None:
    with replacing(path) as temporary, temporary.open("wb") as file:
        try:
            torch.save(saved, file)
        except RuntimeError as error:                            # how torch's writer reports that a write fell short
            raise OSError(f"{path}: cannot be written; {error}") from error
        file.flush()
        os.fsync(file.fileno())


def restore(path: Path, saved: dict[str, Any], config: FitConfig, capture: Capture, device: torch.device,
            ranks: Ranks = ALONE) -> FitState:
    """The state of the fit that `config` and `capture` describe, from what `read_checkpoint(path)` gave.

    Raises:
        ValueError: naming the file, if it is of another fit: the first field that differs, or the photos; or the folder of its splats, if that
            is broken.
    """
    for item in fields(FitConfig):
        ours, theirs = getattr(config, item.name), saved["config"].get(item.name)
        if item.metadata["decides"] and ours != theirs:
            raise ValueError(f"{path}: made with {item.name} = {theirs!r}; expected {ours!r} as now asked for. "
                             "Ask for what it was made with, start afresh (--fresh, or resume=False), or choose another folder")
    if saved["photos"] != _photos(capture):
        raise ValueError(f"{path}: made from other photos, or ones of another size; start afresh (--fresh, or resume=False), or choose "
                         "another folder")
    return FitState.from_state_dict(load_rows(path, saved, ranks), capture, config, device, ranks)


def read_checkpoint(path: Path) -> dict[str, Any]:
    """What `save_checkpoint` wrote.

    Raises:
        ValueError: naming the file, if it is something else or broken.
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        try:
            saved = torch.load(file, map_location="cpu", weights_only=True)
        except (RuntimeError, EOFError, OSError, pickle.UnpicklingError) as error:      # all of which torch makes of broken files
            reason = str(error).partition("\n")[0]
            raise ValueError(f"{path}: expected a checkpoint of `tsplat fit`; it cannot be read ({reason})") from None
    if not isinstance(saved, dict) or saved.get("format") != FORMAT:
        raise ValueError(f"{path}: expected a checkpoint of `tsplat fit` (format {FORMAT!r}); it is something else")
    return saved


def _photos(capture: Capture) -> dict[str, Any]:
    """What tells the photos of one fit from those of another."""
    return {"names": capture.names, "width": capture.width, "height": capture.height, "test": capture.test}
