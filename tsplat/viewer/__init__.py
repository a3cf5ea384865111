"""A web page to look at scenes, and at fits while they go on. `Page` needs the package viser: `pip install 'tsplat[viewer]'`."""

from tsplat.viewer.loop import RenderLoop
from tsplat.viewer.training import TrainingView
from tsplat.viewer.view import Settings, draw_view
from tsplat.viewer.views import Views

__all__ = ["RenderLoop", "Settings", "TrainingView", "Views", "draw_view"]
