"""Pure-torch splat rendering, stage by stage: the CPU path of tsplat and the oracle of its kernels. Imports torch only."""

from tsplat_reference.allocator import keep_freed_memory
from tsplat_reference.binning import Bins as Bins
from tsplat_reference.binning import bin_splats as bin_splats
from tsplat_reference.binning import tile_counts as tile_counts
from tsplat_reference.blending import blend as blend
from tsplat_reference.blocks import blend_blocks as blend_blocks
from tsplat_reference.blocks import blend_blocks_backward as blend_blocks_backward
from tsplat_reference.camera import camera_centers as camera_centers
from tsplat_reference.frustum import frustum_planes as frustum_planes
from tsplat_reference.frustum import may_see as may_see
from tsplat_reference.harmonics import harmonics as harmonics
from tsplat_reference.harmonics import harmonics_backward as harmonics_backward
from tsplat_reference.projection import Projection as Projection
from tsplat_reference.projection import ProjectionGradients as ProjectionGradients
from tsplat_reference.projection import covariances as covariances
from tsplat_reference.projection import project as project
from tsplat_reference.projection import project_backward as project_backward
from tsplat_reference.sphere_blocks import SphereGradients as SphereGradients
from tsplat_reference.sphere_blocks import background_gradients as background_gradients
from tsplat_reference.sphere_blocks import blend_sphere_blocks as blend_sphere_blocks
from tsplat_reference.sphere_blocks import blend_sphere_blocks_backward as blend_sphere_blocks_backward
from tsplat_reference.sphere_blocks import softmax_gradient as softmax_gradient
from tsplat_reference.sphere_tracking import hit_weights as hit_weights
from tsplat_reference.sphere_tracking import nearest_hits as nearest_hits
from tsplat_reference.spheres import Outlines as Outlines
from tsplat_reference.spheres import SphereImages as SphereImages
from tsplat_reference.spheres import blend_spheres as blend_spheres
from tsplat_reference.spheres import outlines as outlines

keep_freed_memory()
