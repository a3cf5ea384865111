"""tsplat: differentiable splat rendering for PyTorch, with nothing to compile."""

from tsplat.camera import Camera as Camera
from tsplat.rasterize import Meta as Meta
from tsplat.rasterize import Rendering as Rendering
from tsplat.rasterize import rasterize as rasterize
from tsplat.scene import Gaussians as Gaussians
from tsplat.scene import Spheres as Spheres
from tsplat.scene import load_capture as load_capture
from tsplat.spheres import Hits as Hits
from tsplat.spheres import SphereRendering as SphereRendering
from tsplat.spheres import render_spheres as render_spheres

__version__ = "0.1.0"
