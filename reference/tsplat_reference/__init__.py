"""Pure-torch splat rendering, stage by stage: the CPU path of tsplat and the oracle of its kernels. Imports torch only."""

from tsplat_reference.binning import Bins as Bins
from tsplat_reference.binning import bin_splats as bin_splats
from tsplat_reference.binning import tile_counts as tile_counts
from tsplat_reference.blending import blend as blend
from tsplat_reference.blocks import blend_blocks as blend_blocks
from tsplat_reference.blocks import blend_blocks_backward as blend_blocks_backward
from tsplat_reference.camera import camera_centers as camera_centers
from tsplat_reference.harmonics import harmonics as harmonics
from tsplat_reference.harmonics import harmonics_backward as harmonics_backward
from tsplat_reference.projection import Projection as Projection
from tsplat_reference.projection import ProjectionGradients as ProjectionGradients
from tsplat_reference.projection import covariances as covariances
from tsplat_reference.projection import project as project
from tsplat_reference.projection import project_backward as project_backward
