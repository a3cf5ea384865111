"""A scene, what of it is whose, and the comparison of what ranks make of it with what one process makes of the whole."""

from __future__ import annotations

import dataclasses
import random
from typing import Any

import scenes
import torch
from compare import assert_close, assert_same_bits, leaves
from ranks import Ranks
from torch import Tensor

from tsplat import Camera, Rendering, rasterize


@dataclasses.dataclass
class Shards:
    """A scene for one process, and what of it is whose.

    sizes: splats of each rank. cameras: of each rank. shared: arguments with splats in the first dimension. views: with cameras in the first
    dimension and splats in the second. own: with cameras in the first dimension, of the rank that renders them. batched: as in `Camera`.
    """

    sizes: list[int]
    cameras: int
    camera: Camera
    shared: dict[str, Tensor]
    views: dict[str, Tensor] = dataclasses.field(default_factory=dict)
    own: dict[str, Tensor] = dataclasses.field(default_factory=dict)
    options: dict[str, Any] = dataclasses.field(default_factory=dict)
    batched: bool = True

    def part(self, rank: int) -> tuple[slice, slice]:
        """The splats and the cameras of a rank."""
        first = sum(self.sizes[:rank])
        return slice(first, first + self.sizes[rank]), slice(rank * self.cameras, (rank + 1) * self.cameras)

    def of(self, rank: int) -> tuple[dict[str, Tensor], Camera]:
        """The arguments of a rank, and its camera."""
        splats, cameras = self.part(rank)
        arguments = ({k: v[splats] for k, v in self.shared.items()} | {k: v[:, splats] for k, v in self.views.items()}
                     | {k: v[cameras] for k, v in self.own.items()})
        camera = self.camera[cameras]
        return arguments, camera if self.batched else camera[0]


def render(arguments: dict[str, Tensor], camera: Camera, options: dict[str, Any]) -> tuple[Rendering, list[Tensor]]:
    """The rendering, and the tensors that it can be differentiated by."""
    inputs = leaves(*arguments.values(), camera.viewmats, camera.Ks)
    given: dict[str, Any] = {"quats": None, "scales": None} | dict(zip(arguments, inputs, strict=False)) | options
    return rasterize(camera=dataclasses.replace(camera, viewmats=inputs[-2], Ks=inputs[-1]), **given), inputs


def outputs(rendering: Rendering, batched: bool = True) -> list[Tensor]:
    """Image, alpha and depth, with the dimension of cameras."""
    return [x if batched else x[None] for x in rendering[:3] if x is not None]


def weighted(values: list[Tensor], weights: list[Tensor]) -> Tensor:
    """A number that all outputs go into."""
    return sum((v * w).sum() for v, w in zip(values, weights, strict=True))  # type: ignore[return-value]


def compare(ranks: Ranks, shards: Shards) -> None:
    """Images to 1e-14: the same sums, but the ends of arrays, which are not vectorised, are elsewhere. Gradients to 1e-12: other sums, too."""
    splats, cameras = shards.part(ranks.rank)
    whole, inputs = render(shards.shared | shards.views | shards.own, shards.camera, shards.options)
    weights = [scenes.normal(*x.shape, seed=scenes.generator(3)) for x in outputs(whole)]
    v_whole = torch.autograd.grad(weighted(outputs(whole), weights), inputs, materialize_grads=True)

    arguments, camera = shards.of(ranks.rank)
    part, inputs = render(arguments, camera, shards.options | {"group": ranks.group})
    got = outputs(part, shards.batched)
    v_part = torch.autograd.grad(weighted(got, [w[cameras] for w in weights]), inputs, materialize_grads=True)

    assert_close(got, [x[cameras] for x in outputs(whole)], 1e-14)
    visible = whole.meta.visible[:, splats]
    for name in ("means2d", "depths"):
        assert_close(getattr(part.meta, name), getattr(whole.meta, name)[:, splats][visible], 1e-14)
    assert_same_bits([part.meta.radii, part.meta.hits, part.meta.visible_ids, part.meta.visible, part.meta.views],
                     [whole.meta.radii[:, splats][visible], whole.meta.hits[cameras], visible.nonzero(), visible, visible.sum(0)])
    names = [*shards.shared, *shards.views, *shards.own, "viewmats", "Ks"]
    for name, wanted, found in zip(names, v_whole, v_part, strict=True):
        kind = "shared" if name in shards.shared else "views" if name in shards.views else "own"
        mine = {"shared": lambda v: v[splats], "views": lambda v: v[:, splats], "own": lambda v: v[cameras]}[kind](wanted)
        found = found.view_as(mine)
        if mine.numel():                                # relative to the whole, as a rank's part may be nearly zero
            off = ((found - mine).abs().max() / wanted.abs().max().clamp_min(1e-300)).item()
            assert off <= 1e-12, f"gradient of {name}: off by {off:.1e} on rank {ranks.rank}"


def shards_of(ranks: Ranks, seed: int, *, sizes: list[int] | None = None, **options: Any) -> Shards:
    """A random scene: numbers of splats and cameras, size of the image, and options."""
    r = random.Random(seed)
    sizes = sizes or [r.randint(0, 40) for _ in range(ranks.count)]
    cameras, n = r.randint(1, 3), sum(sizes)
    channels, degree, antialiased = r.choice((1, 3, 5)), r.choice((None, 0, 2)), r.random() < 0.5
    splats = scenes.splats(n, seed=seed, channels=channels)
    camera = scenes.camera(cameras * ranks.count, r.randint(1, 40), r.randint(1, 40), model=r.choice(("pinhole", "orthographic", "fisheye")),
                           seed=seed)
    shared, g = splats._asdict(), scenes.generator(seed)
    shared["colors"] = splats.colors if degree is None else scenes.sh_coefficients(n, degree, channels, seed=seed)
    if r.random() < 0.3:
        root = scenes.normal(n, 3, 3, seed=g) * 0.2
        shared["covars"] = root @ root.mT + 1e-3 * torch.eye(3, dtype=torch.float64)
        del shared["quats"], shared["scales"]
    shards = Shards(sizes, cameras, camera, shared, batched=cameras > 1 or r.random() < 0.5, options={
        "sh_degree": degree, "antialiased": antialiased, "depth": r.choice((None, "accumulated", "expected"))} | options)
    if r.random() < 0.5:
        shards.own["background"] = scenes.uniform(0.0, 1.0, len(camera), channels, seed=g)
    if r.random() < 0.5:
        shards.views["screen_offset"] = scenes.normal(len(camera), n, 2, seed=g) * 0.1
    if r.random() < 0.5:
        shards.views["absgrad"] = torch.zeros(len(camera), n, 2, dtype=torch.float64)
    if degree is None and r.random() < 0.5:
        shards.views["colors"] = scenes.uniform(0.0, 1.0, len(camera), n, channels, seed=g)
        del shards.shared["colors"]
    return shards
