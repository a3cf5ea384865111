"""Splats over many processes: `tsplat.rasterize(..., group=group)`, on `torch.distributed`.

Each rank of the group owns some of the splats and some of the cameras (as Grendel does: Zhao et al. 2024, "On Scaling Up 3D Gaussian Splatting
Training"). A call does, on every rank:

1. compare what has to be equal on all ranks, so that a mistake is an error everywhere rather than a process that waits for ever, and
   gather the cameras (25 numbers each);
2. choose the own splats that each camera of all ranks may see, project these into it, and evaluate the colours of those that it does see (SH
   coefficients never travel);
3. tell each rank how many splats it will get (one int64 per camera), and send the visible ones, 7 + D numbers each for D channels, and
   2 more with `absgrad`, which backward fills;
4. bin and blend what came, for the own cameras.

Backward goes the same way back: gradients of splats, `screen_offset` and `absgrad` end on the rank that owns the splat, gradients of
`viewmats` and `Ks` on the rank that owns the camera. Ranks count as blocks: splat n of rank r is splat n + (splats of ranks before r) of one
process, which decides between equal depths, so that images are those of one process.

**In a training loop** (`torchrun` starts the processes, `torch.distributed.init_process_group` joins them):

    group = torch.distributed.group.WORLD
    scene = ...                                  # this rank's part of the splats, and an optimiser of its own for them
    for step in range(steps):
        camera, photos = ...                     # this rank's cameras: as many, and of the same size, on every rank
        rendering = tsplat.rasterize(..., camera, group=group)
        loss = distance(rendering.image, photos) / group.size()
        loss.backward()                          # on every rank, also where nothing is visible: it communicates
        optimiser.step()

- What is minimised is the *sum* of the ranks' losses: each rank calls backward on its own, and gradients meet at the owners. So let each
  loss be a mean over the own pixels, divided by the number of ranks; then the sum is the mean over the batch of all cameras.
- Gradients of splats must not be reduced: no DistributedDataParallel around the scene, as each splat lives on one rank only.
- What every rank has a copy of (a network, a background, poses of all photos) gets one gradient per rank: all-reduce these by sum. What
  belongs to the rank's own cameras needs nothing.
- Regularisers of splats are sums over the own splats, divided by the number of splats of *all* ranks where they are means, and not by
  the number of ranks.
- Density control works on each rank alone: `screen_offset` and `absgrad` are `[ranks C, N]`, the own splats in all cameras, those of rank 0
  first; `meta.radii`, `meta.means2d` and `meta.depths` are rows of the pairs that were drawn, whose cameras and splats are `meta.visible_ids`, and
  `meta.views` counts cameras by splat. With the loss above, screen-space gradients are those of a batch: the number of all cameras times
  smaller than of a loss of one image, for which thresholds are made. Ranks grow differently; when their numbers differ much, move splats (a
  plain `all_to_all_single` of rows) between steps. The objects of `tsplat.fit.density` know of ranks (`tsplat.fit.ranks.Ranks`) and do all this
  but the moving, and `tsplat.fit.fit(..., group=group)` is a whole training loop.

All ranks make the same calls in the same order. What only one rank can see (a tensor of a wrong shape) raises on that rank only; `torchrun`
then ends the others. Under torch.compile, what differs between ranks raises without saying what.

Memory: per own splat and camera of *all* ranks one byte, for a moment, and 8 for the gradient of `screen_offset` or `absgrad` where these are given;
what is projected, and held for backward, is what a camera may see, about 1000 bytes each with the drawing (`bench/distributed.py`, which measures it
and says what 40M and 1B splats take). Fisheye cameras may see all in front of them: of these pairs, 100 bytes each are held. The drop-in for gsplat
projects all into all, as its `meta` has them.
"""

from tsplat.distributed.collectives import check_group as check_group
from tsplat.distributed.exchange import send as send
from tsplat.distributed.gathering import gather_cameras as gather_cameras
from tsplat.distributed.projection import project as project
