"""The nearest hits of each pixel (Pulsar, section 3.2: the spheres that are tracked)."""

from __future__ import annotations

import torch
from torch import Tensor

from tsplat_reference.blending import to_image
from tsplat_reference.camera import split_intrinsics
from tsplat_reference.sphere_blocks import SphereScene, fill_hits
from tsplat_reference.spheres import ray_hits
from tsplat_reference.walk import Chunk, Memory, arrays


def nearest_hits(centers: Tensor, radii: Tensor, Ks: Tensor, ids: Tensor, offsets: Tensor, count: int, width: int, height: int, tile: int,
                 model: str, near: float, far: float, chord: bool) -> Tensor:
    """The `count` nearest hits of each pixel, in the order of their distance: int32 `[C, H, W, count]`, the sphere's index n, or -1; no gradients.

    Args: as those of `blend_spheres`.
    """
    C, N = centers.shape[:2]
    dummy = centers.new_zeros(1, N)
    scene = SphereScene.of(centers, radii, dummy, dummy[..., None], centers.new_ones(()), Ks, ids, offsets[:-1], offsets.diff(), width, height,
                           tile, model, near, far, 0.0, chord)
    lists, pixels = scene.lists, tile * tile
    depths = centers.new_full((len(lists.counts), pixels, count), torch.inf)
    found = torch.full(depths.shape, -1, dtype=torch.int32, device=depths.device)
    memory = Memory(centers, pixels, count, 4, arrays)
    nearest = scene.records[:, 2] if scene.orthographic else torch.linalg.vector_norm(scene.records[:, :3], dim=1)
    nearest = nearest - scene.records[:, 3]

    def alive(some: Tensor, begin: int) -> Tensor:
        """Whether what comes next may be nearer than the last that was found."""
        first = ids[(lists.starts[some] + begin).clamp_(max=len(ids) - 1)].long()
        return nearest[first] < depths[some, :, -1].amax(1)

    def insert(chunk: Chunk) -> Chunk:
        group = scene.group(chunk)
        sphere = (chunk.splats % N).to(torch.int32).view(chunk.padding.shape)
        for rows, k, (s, h, d, D) in memory.blocks(chunk):
            fill_hits(scene, group.part(rows, k), s, h, d, D)
            D.masked_fill_(d <= 0, torch.inf)
            tiles = chunk.tiles[rows]
            both = torch.cat([depths[tiles], D.mT], -1)
            names = torch.cat([found[tiles], sphere[rows, None, :k].expand(-1, pixels, -1)], -1)
            best, order = both.topk(count, largest=False)
            depths[tiles] = best
            found[tiles] = names.gather(-1, order).masked_fill_(best == torch.inf, -1)
        return chunk

    for _ in lists.run(insert, alive, count):
        pass
    return to_image(found.mT, lists.shape, width, height)


def hit_weights(centers: Tensor, radii: Tensor, opacities: Tensor, gamma: Tensor, Ks: Tensor, logsumexp: Tensor, hits: Tensor, model: str,
                near: float, far: float, background_depth: float, chord: bool) -> tuple[Tensor, Tensor]:
    """Distance D (infinite where there is no hit) and weight of each of the `hits` `[C, H, W, n]` of `nearest_hits`, differentiable.

    Args: as those of `blend_spheres`, and its logsumexp.
    """
    C, H, W, n = hits.shape
    is_hit = hits >= 0
    index = torch.where(is_hit, hits, centers.shape[1]).long().view(C, -1)                  # of a sphere of zeros where there is none

    def take(values: Tensor) -> Tensor:
        return torch.nn.functional.pad(values.expand(C, -1), (0, 1)).gather(1, index).view(C, H, W, n)

    fx, fy, cx, cy = (v[..., None, None] for v in split_intrinsics(Ks))
    column = torch.arange(W, device=hits.device, dtype=centers.dtype)[:, None] + 0.5
    row = torch.arange(H, device=hits.device, dtype=centers.dtype)[:, None, None] + 0.5
    x, y, z = (take(v) for v in centers.unbind(-1))
    R, o = take(radii), take(opacities)
    _, d, D = ray_hits((column - cx) / fx, (row - cy) / fy, x, y, z, R, model, near, far, chord)
    logit = (o * (1 - (D - near) / (far - near)) - background_depth) / gamma - logsumexp[..., None]
    weights = o * d * torch.where(is_hit, logit, 0.0).exp()
    return torch.where(is_hit, D, torch.inf), torch.where(is_hit, weights, 0.0)
