"""The folder that a fit writes to."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

import tsplat
from tsplat.fit.checkpoint import read_checkpoint
from tsplat.fit.config import FitConfig
from tsplat.fit.evaluation import Quality, mean_quality
from tsplat.fit.losses import SSIM_NAME
from tsplat.fit.primitive import Scene
from tsplat.fit.shards import remove_others
from tsplat.scene.files import replacing


class Output:
    """The names of what a fit writes into `folder`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.checkpoint, self.scene = folder / "checkpoint.pt", folder / "scene.ply"
        self.metrics, self.pictures = folder / "metrics.json", folder / "test"
        self.config, self.curves, self.sheet = folder / "config.json", folder / "curves.png", folder / "contact.png"
        self.turntable = folder / "turntable.gif"

    def open(self) -> dict[str, Any] | None:
        """Make the folder if need be; the checkpoint in it (see `read_checkpoint`), or None. What a write that was cut short left goes.

        Raises:
            FileExistsError: the folder is a file, or holds files of these names but no checkpoint, which would show that
                they are from a fit and may be written over.
            ValueError: `checkpoint.pt` is not from a fit.
        """
        if self.folder.exists() and not self.folder.is_dir():
            raise FileExistsError(f"{self.folder}: expected a folder to write to; it is a file")
        self.folder.mkdir(parents=True, exist_ok=True)
        if self.checkpoint.exists():
            saved = read_checkpoint(self.checkpoint)
            remove_others(self.checkpoint, saved)
            return saved
        ours = (self.scene, self.metrics, self.pictures, self.config, self.curves, self.sheet, self.turntable)
        found = next((path for path in ours if path.exists()), None)
        if found is not None:
            raise FileExistsError(f"{found}: would be written over, but is not from a fit (there is no {self.checkpoint.name} "
                                  "beside it); choose another folder")
        remove_others(self.checkpoint, None)
        return None

    def write(self, gaussians: Scene, config: FitConfig, qualities: dict[str, Quality], refined: dict[str, Quality], seconds: float) -> None:
        """Write the scene, its metrics and what made it, each whole or not at all."""
        gaussians.save(self.scene)
        write_json(self.config, {"tsplat": tsplat.__version__, "torch": torch.__version__, "config": asdict(config)})
        write_json(self.metrics, {**metrics_of(qualities, refined), "splats": len(gaussians), "seconds": round(seconds, 3),
                                  "config": asdict(config)})


def metrics_of(qualities: dict[str, Quality], refined: dict[str, Quality] | None = None) -> dict[str, Any]:
    """What `metrics.json` says of quality: per image and mean; `refined` is with refined poses."""
    metrics: dict[str, Any] = {"ssim": SSIM_NAME}
    for suffix, some in (("", qualities), ("_with_refined_poses", refined)):
        if some or not suffix:
            mean = mean_quality(some or {})
            metrics[f"mean{suffix}"] = None if mean is None else mean._asdict()
            metrics[f"images{suffix}"] = {name: quality._asdict() for name, quality in (some or {}).items()}
    return metrics


def read_config(path: Path) -> FitConfig:
    """The config in a `config.json`.

    Raises:
        ValueError: naming the file, if it is something else, or holds a field that is unknown or out of range.
        OSError: it cannot be read.
    """
    try:
        return FitConfig(**json.loads(path.read_text(encoding="utf-8"))["config"])
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: expected a config.json of `tsplat fit`; {error}") from None


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
