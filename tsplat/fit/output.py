"""The folder that a fit writes to."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tsplat.fit.checkpoint import read_checkpoint
from tsplat.fit.config import FitConfig
from tsplat.fit.evaluation import Quality, mean_quality
from tsplat.fit.losses import SSIM_NAME
from tsplat.fit.primitive import Scene
from tsplat.scene.files import replacing


class Output:
    """The names of what a fit writes into `folder`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.checkpoint, self.scene = folder / "checkpoint.pt", folder / "scene.ply"
        self.metrics, self.pictures = folder / "metrics.json", folder / "test"

    def open(self) -> dict[str, Any] | None:
        """Make the folder if need be; the checkpoint in it (see `read_checkpoint`), or None.

        Raises:
            FileExistsError: the folder is a file, or holds files of these names but no checkpoint, which would show that
                they are from a fit and may be written over.
            ValueError: `checkpoint.pt` is not from a fit.
        """
        if self.folder.exists() and not self.folder.is_dir():
            raise FileExistsError(f"{self.folder}: expected a folder to write to; it is a file")
        self.folder.mkdir(parents=True, exist_ok=True)
        if self.checkpoint.exists():
            return read_checkpoint(self.checkpoint)
        found = next((path for path in (self.scene, self.metrics, self.pictures) if path.exists()), None)
        if found is not None:
            raise FileExistsError(f"{found}: would be written over, but is not from a fit (there is no {self.checkpoint.name} "
                                  "beside it); choose another folder")
        return None

    def write(self, gaussians: Scene, config: FitConfig, qualities: dict[str, Quality], refined: dict[str, Quality], seconds: float) -> None:
        """Write the scene and its metrics, each whole or not at all."""
        gaussians.save(self.scene)
        mean, mean_refined = mean_quality(qualities), mean_quality(refined)
        metrics = {
            "mean": None if mean is None else mean._asdict(),
            "images": {name: quality._asdict() for name, quality in qualities.items()},
            **({} if mean_refined is None else {
                "mean_with_refined_poses": mean_refined._asdict(),
                "images_with_refined_poses": {name: quality._asdict() for name, quality in refined.items()},
            }),
            "ssim": SSIM_NAME,
            "splats": len(gaussians),
            "seconds": round(seconds, 3),
            "config": asdict(config),
        }
        with replacing(self.metrics) as temporary:
            temporary.write_text(json.dumps(metrics, indent=2) + "\n", encoding="utf-8")
