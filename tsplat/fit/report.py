"""What is left of a fit for people: its curves, a sheet of held-out photos, and numbers for TensorBoard."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.nn.functional import interpolate, pad

from tsplat.fit.comparison import error_picture
from tsplat.fit.plot import curves
from tsplat.scene import read_image, write_image

if TYPE_CHECKING:
    from tsplat.fit.trainer import Step

BINS = 500               # points of a curve, at most
SHEET_ROWS, SHEET_SIDE = 8, 240


@dataclass
class History:
    """Means of loss and PSNR over intervals of the steps, and the number of splats at their ends.

    Args:
        rows: step, loss, PSNR in dB and splats, of whole intervals.
        sums: of loss and PSNR since, and how many steps.
    """

    rows: list[list[float]] = field(default_factory=list)
    sums: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])

    def add(self, step: int, steps: int, loss: float, psnr: float, splats: int) -> None:
        """Take note of step `step` of `steps`."""
        self.sums = [self.sums[0] + loss, self.sums[1] + psnr, self.sums[2] + 1]
        last = int(self.rows[-1][0]) if self.rows else 0
        interval = max(1, steps // BINS)
        if step // interval > last // interval or step >= steps:           # steps of several photos count these, and jump over multiples
            self.rows.append([float(step), self.sums[0] / self.sums[2], self.sums[1] / self.sums[2], float(splats)])
            self.sums = [0.0, 0.0, 0.0]

    def write(self, path: Path) -> None:
        """Draw the curves to a PNG."""
        x, loss, psnr, splats = zip(*self.rows, strict=True) if self.rows else ((), (), (), ())
        write_image(path, curves([("LOSS", x, loss), ("PSNR DB", x, psnr), ("SPLATS", x, splats)]))


def write_sheet(path: Path, pictures: Sequence[Path]) -> None:
    """A PNG with a row of photo, render and error (four times the difference) for some of the pictures of `evaluate`."""
    step = max(1, -(-len(pictures) // SHEET_ROWS))
    rows = []
    for picture in pictures[::step]:
        photo, render = (read_image(picture).float() / 255).chunk(2, dim=1)
        rows.append(torch.cat([_small(image) for image in (photo, render, error_picture(photo, render))], dim=1))
    width = max(row.shape[1] for row in rows)
    write_image(path, torch.cat([pad(row, (0, 0, 0, width - row.shape[1])) for row in rows]))


def to_writer(writer: Any) -> Callable[[Step], None]:
    """A callback that writes loss, PSNR and splats of each step to `writer`, a `torch.utils.tensorboard.SummaryWriter` or whatever
    has its `add_scalar(tag, value, step)`.
    """
    def write(step: Step) -> None:
        for tag, value in (("loss", step.loss), ("psnr", step.psnr), ("splats", len(step.gaussians))):
            writer.add_scalar(tag, value, step.number)
    return write


def _small(image: Tensor) -> Tensor:
    """`[H, W, 3]`, no side longer than `SHEET_SIDE`."""
    scale = min(1.0, SHEET_SIDE / max(image.shape[:2]))
    size = [max(1, round(scale * side)) for side in image.shape[:2]]
    small: Tensor = interpolate(image.permute(2, 0, 1)[None], size=size, mode="area")[0]
    return small.permute(1, 2, 0)
