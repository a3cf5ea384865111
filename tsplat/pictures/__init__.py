"""Pictures of scenes: colours, depth, alpha and normals, the views to take them from, and clips."""

from tsplat.pictures.colormap import viridis
from tsplat.pictures.modes import MODES, Layers, Mode, draw_layers, picture
from tsplat.pictures.normals import camera_points, normals

__all__ = ["MODES", "Layers", "Mode", "camera_points", "draw_layers", "normals", "picture", "viridis"]
