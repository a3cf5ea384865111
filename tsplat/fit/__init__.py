"""Fitting scenes to photos."""

from tsplat.fit.config import FitConfig
from tsplat.fit.drawing import draw
from tsplat.fit.evaluation import Quality, evaluate
from tsplat.fit.report import to_writer
from tsplat.fit.trainer import FitResult, Step, fit

__all__ = ["FitConfig", "FitResult", "Quality", "Step", "draw", "evaluate", "fit", "to_writer"]
