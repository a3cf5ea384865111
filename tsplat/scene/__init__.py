"""Scenes: the trainable `Gaussians`, and the files that they and their photos come in."""

from tsplat.scene.capture import Capture, load_capture
from tsplat.scene.colmap import read_colmap
from tsplat.scene.gaussians import Gaussians
from tsplat.scene.image_files import read_image, write_image
from tsplat.scene.images import ImageStore, Photo
from tsplat.scene.lens import Lens
from tsplat.scene.load import load_scene
from tsplat.scene.ply import read_ply, write_ply
from tsplat.scene.spheres import Spheres
from tsplat.scene.synthetic import synthetic_cameras, synthetic_scene, write_synthetic_capture
from tsplat.scene.transforms import read_transforms
from tsplat.scene.view import View

__all__ = [
    "Capture", "Gaussians", "ImageStore", "Lens", "Photo", "Spheres", "View", "load_capture", "load_scene", "read_colmap", "read_image", "read_ply",
    "read_transforms", "synthetic_cameras", "synthetic_scene", "write_image", "write_ply", "write_synthetic_capture",
]
