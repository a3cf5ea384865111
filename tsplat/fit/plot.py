"""Curves of a fit as a picture, drawn pixel by pixel: a line plot is not worth a plotting library as a dependency."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor

WIDTH, HEIGHT, LEFT, TOP, BOTTOM = 640, 180, 60, 18, 18        # of a panel, in pixels; margins for text
INK, GREY, LINE = 0.1, 0.8, (0.1, 0.35, 0.75)
GLYPHS = {                                                     # 5 rows of 3 bits
    "0": "75557", "1": "26227", "2": "71747", "3": "71717", "4": "55711", "5": "74717", "6": "74757", "7": "71122", "8": "75757", "9": "75717",
    ".": "00002", "-": "00700", "A": "25755", "B": "65656", "D": "65556", "E": "74647", "L": "44447", "N": "75555", "O": "75557", "P": "65644",
    "R": "65655", "S": "34216", "T": "72222", " ": "00000",
}


def curves(panels: Sequence[tuple[str, Sequence[float], Sequence[float]]]) -> Tensor:
    """One panel below the other, each with a title of capital letters, x and y: `[H, W, 3]` in 0..1.

    Axes go from the least to the greatest finite value, which are written beside them. Other values are left out.
    """
    return torch.cat([_panel(*panel) for panel in panels])


def _panel(title: str, x: Sequence[float], y: Sequence[float]) -> Tensor:
    image = torch.ones(HEIGHT, WIDTH, 3)
    bottom, right = HEIGHT - BOTTOM, WIDTH - 12
    image[TOP, LEFT:right] = image[bottom, LEFT:right] = GREY
    image[TOP:bottom, LEFT] = image[TOP:bottom, right] = GREY
    _write(image, title, LEFT, 4)
    points = torch.tensor([x, y], dtype=torch.float64).T.reshape(-1, 2)
    points = points[points.isfinite().all(1)]
    if not len(points):
        return image
    (x0, y0), (x1, y1) = points.amin(0).tolist(), points.amax(0).tolist()
    for value, row in ((y1, TOP), (y0, bottom - 10)):
        _write(image, _number(value), 4, row)
    for value, column in ((x0, LEFT), (x1, right - 60)):
        _write(image, _number(value), column, bottom + 5)
    low, span = points.new_tensor([x0, y0]), points.new_tensor([(x1 - x0) or 1.0, (y1 - y0) or 1.0])
    place = (points - low) / span * points.new_tensor([right - LEFT - 2.0, -(bottom - TOP - 2.0)]) + points.new_tensor([LEFT + 1.0, bottom - 1.0])
    for start, end in itertools.pairwise(place):
        count = int((end - start).abs().max().ceil()) + 1
        columns, rows = (start + (end - start) * torch.linspace(0, 1, count, dtype=torch.float64)[:, None]).round().long().unbind(1)
        image[rows, columns] = torch.tensor(LINE)
    return image


def _number(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}" if abs(value) >= 1e-3 or not value else f"{value:.4f}"


def _write(image: Tensor, text: str, left: int, top: int) -> None:
    """Letters of 6 x 10 pixels."""
    for i, letter in enumerate(text):
        rows = [[int(row) >> bit & 1 for bit in (2, 1, 0)] for row in GLYPHS[letter]]
        glyph = torch.tensor(rows, dtype=torch.bool).repeat_interleave(2, 0).repeat_interleave(2, 1)       # [10, 6]
        image[top:top + 10, left + 8 * i:left + 8 * i + 6][glyph] = INK
