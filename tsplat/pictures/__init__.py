"""Pictures of scenes: colours, depth, alpha and normals, the views to take them from, and clips."""

from tsplat.pictures.clip import CLIPS, FPS, check_clip, write_clip
from tsplat.pictures.colormap import viridis
from tsplat.pictures.modes import MODES, Layers, Mode, depth_range, draw_layers, picture
from tsplat.pictures.normals import camera_points, normals
from tsplat.pictures.views import capture_path, orbit

__all__ = ["CLIPS", "FPS", "MODES", "Layers", "Mode", "camera_points", "capture_path", "check_clip", "depth_range", "draw_layers", "normals",
           "orbit", "picture", "viridis", "write_clip"]
