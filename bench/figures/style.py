"""What the figures share: colours, sizes, and the command line."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import matplotlib

matplotlib.use("agg")
from matplotlib.figure import Figure

BLUE, ORANGE, GREEN, RED, GREY = "#2f6fb0", "#e08214", "#3a923a", "#c1373c", "#888888"


def save(draw: Callable[[], Figure], file: str, description: str | None) -> None:
    """Write the figure that `draw` makes to OUT, default the script's name with .png, in its folder."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", nargs="?", type=Path, default=Path(file).with_suffix(".png"))
    draw().savefig(parser.parse_args().out, dpi=130)


def figure(width: float, height: float) -> Figure:
    """Empty, of so many inches."""
    matplotlib.rcParams.update({"font.size": 8.5, "axes.titlesize": 9, "axes.spines.top": False, "axes.spines.right": False,
                                "legend.frameon": False})
    return Figure(figsize=(width, height), layout="constrained")
