"""Checkpoints: files from which a fit goes on as if it had never stopped, written whole or not at all."""

from __future__ import annotations

import os
import pickle
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import torch

from tsplat.fit.config import FitConfig
from tsplat.fit.state import FitState
from tsplat.scene import Capture
from tsplat.scene.files import replacing

FORMAT = "tsplat fit 2"


def save_checkpoint(path: Path, state: FitState, config: FitConfig, capture: Capture) -> None:
    """Write `path`; an older file stays until the new one is on the disk.

    Raises:
        OSError: it cannot be written (a full disk); the older file stays as it was.
    """
    saved = {"format": FORMAT, "state": state.state_dict(), "config": asdict(config), "photos": _photos(capture)}
    with replacing(path) as temporary, temporary.open("wb") as file:
        try:
            torch.save(saved, file)
        except RuntimeError as error:                            # how torch's writer reports that a write fell short
            raise OSError(f"{path}: cannot be written; {error}") from error
        file.flush()
        os.fsync(file.fileno())


def restore(path: Path, saved: dict[str, Any], config: FitConfig, capture: Capture, device: torch.device) -> FitState:
    """The state of the fit that `config` and `capture` describe, from what `read_checkpoint(path)` gave.

    Raises:
        ValueError: naming the file, if it is of another fit: the first field that differs, or the photos.
    """
    for item in fields(FitConfig):
        ours, theirs = getattr(config, item.name), saved["config"].get(item.name)
        if item.metadata["decides"] and ours != theirs:
            raise ValueError(f"{path}: made with {item.name} = {theirs!r}; expected {ours!r} as now asked for. "
                             "Ask for what it was made with, start afresh (resume=False), or choose another folder")
    if saved["photos"] != _photos(capture):
        raise ValueError(f"{path}: made from other photos, or ones of another size; start afresh (resume=False), or choose "
                         "another folder")
    return FitState.from_state_dict(saved["state"], capture, config, device)


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
