"""The numbers that decide what is drawn; one home for the reference and the kernels."""

import math

ALPHA_MIN = 1 / 255
"""A splat does not touch a pixel where its alpha is below this (3DGS, section 6)."""

ALPHA_MAX = 0.99
"""Alpha is clamped to this, with zero gradient there (gsplat up to 1.5.3: 0.999)."""

TRANSMITTANCE_MIN = 1e-4
"""A splat contributes while the transmittance in front of it is above this; what is dropped weighs at most this much."""

EPS2D = 0.3
"""Added to the diagonal of the projected covariance, in pixels squared: the low-pass filter of EWA splatting."""

BIN_SLACK = 1e-3
"""Added, with its relative twin, to the squared radius of the ellipse in tile tests: rounding may add a hit, but never lose one."""
BIN_SLACK_RELATIVE = 1e-4

BIN_ROUNDING = 4
"""Slack of tile tests for rounding of the conic and, twice that, of positions, in units of eps: see `bin_splats`."""

FLATTEST = 1e-30
"""In tile tests, the least entry of a conic: a splat of 1e15 pixels, beyond which quotients might overflow float32."""

FRUSTUM_MARGIN = 0.3
"""x/z and y/z in the pinhole Jacobian are clamped to the frustum widened by this part of its half size."""

VIEW_SLACK = 1e-4
"""Relative slack of sizes and opacities in the test of what a camera may see."""

COMPENSATION_MIN = 0.005
"""Floor of the antialiasing compensation sqrt(det(before blur) / det(after)) (gsplat main and Inria; gsplat 1.5.3: 0)."""

LARGEST = 1e12
"""Means, scales and square roots of covariances beyond this are degenerate: such splats are culled."""

EVERYWHERE = 1e-20
"""The conic of a sphere's outline that is not an ellipse: an ellipse that holds any image."""

ON_OUTLINE = ALPHA_MIN * math.exp(0.5)
"""The opacity with which binning takes (dx, dy) conic (dx, dy) <= 1 for the ellipse of a splat."""
