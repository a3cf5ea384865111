"""One dispatcher op per stage and direction. CPU tensors run the reference; torch.compile, autograd and opcheck see ops."""

from tsplat.ops.adam import adam_rows as adam_rows
from tsplat.ops.binning import bin_splats as bin_splats
from tsplat.ops.binning import bin_splats_fixed as bin_splats_fixed
from tsplat.ops.blending import blend as blend
from tsplat.ops.frustum import may_see as may_see
from tsplat.ops.harmonics import harmonics as harmonics
from tsplat.ops.projection import project as project
from tsplat.ops.spheres import blend_spheres as blend_spheres
from tsplat.ops.spheres import nearest_hits as nearest_hits
from tsplat.ops.spheres import outlines as outlines
