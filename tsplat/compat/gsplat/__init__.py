"""The interface of gsplat 1.5.3, on tsplat's ops: change `from gsplat import ...` to `from tsplat.compat.gsplat import ...`.

Results are gsplat's to rounding, by its rules (alpha at most 0.999; a pixel ends without the splat that takes its transmittance to 1e-4),
with these differences:

| | gsplat 1.5.3 | here |
| --- | --- | --- |
| `Ks` | no gradient | the gradient |
| `rasterize_mode="antialiased"` | opacity times sqrt(det ratio), down to 0 | not below 0.005, as gsplat's main and Inria |
| splats that are not finite, or have a zero quaternion | NaN in image and gradients | left out, gradient 0 |
| `meta` | a dict | a mapping, whose lists of tiles are made when first read |
| `isect_ids`, ... of `meta` | what is rendered from | the same lists; rendered from smaller tiles, hit more exactly |
| `distributed=True` | `meta` has lists of tiles | it has none; else the same, over the default group (`tsplat.distributed`) |
| channels | up to 513 | any number; `channel_chunk` and `segmented` change nothing |
| `packed=True` | less memory | the same results; less memory from blending on |
| `tile_size` on a GPU | any (untested but 16) | a multiple of 8 in `rasterize_to_pixels` |
| `DefaultStrategy` | never resets opacities (a slip of `&` in 1.5.3) | resets every `reset_every` steps, as documented |
| wrong arguments | assertions | `ValueError`, `TypeError` that say what is expected |

3DGUT (`with_ut`, `with_eval3d`, distortion, rolling shutter), f-theta and lidar cameras and 2DGS raise `NotImplementedError`.
"""

from tsplat.compat.gsplat.exporter import export_splats as export_splats
from tsplat.compat.gsplat.optimizers import SelectiveAdam as SelectiveAdam
from tsplat.compat.gsplat.rendering import RollingShutterType as RollingShutterType
from tsplat.compat.gsplat.rendering import rasterization as rasterization
from tsplat.compat.gsplat.stages import fully_fused_projection as fully_fused_projection
from tsplat.compat.gsplat.stages import quat_scale_to_covar_preci as quat_scale_to_covar_preci
from tsplat.compat.gsplat.stages import rasterize_to_pixels as rasterize_to_pixels
from tsplat.compat.gsplat.stages import spherical_harmonics as spherical_harmonics
from tsplat.compat.gsplat.strategy import DefaultStrategy as DefaultStrategy
from tsplat.compat.gsplat.strategy import MCMCStrategy as MCMCStrategy
from tsplat.compat.gsplat.strategy import Strategy as Strategy
from tsplat.compat.gsplat.tiles import isect_offset_encode as isect_offset_encode
from tsplat.compat.gsplat.tiles import isect_tiles as isect_tiles


def rasterization_2dgs(*_: object, **__: object) -> None:
    """Not there yet."""
    raise NotImplementedError("rasterization_2dgs: tsplat has no 2D Gaussian splatting yet")
