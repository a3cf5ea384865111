"""`torch.compile(fullgraph=True)` of calls with a group."""

from __future__ import annotations

import dataclasses

import scenes
import torch
from compare import assert_same_bits, leaves
from ranks import Ranks, expect
from shards import Shards, compare, outputs, shards_of
from torch import Tensor

from tsplat import Camera, rasterize


def check_compiled_whole(ranks: Ranks) -> None:
    """`fullgraph=True`, forward and backward, with splats that come and go between calls."""
    shards = Shards([10 + r for r in range(ranks.count)], 2, scenes.camera(2 * ranks.count), scenes.splats(sum(
        10 + r for r in range(ranks.count)))._asdict(), options={"depth": "expected"})
    shards.views["absgrad"] = torch.zeros(len(shards.camera), sum(shards.sizes), 2, dtype=torch.float64)

    def image(means: Tensor, viewmats: Tensor, rest: dict[str, Tensor], camera: Camera) -> list[Tensor]:
        return outputs(rasterize(means, camera=dataclasses.replace(camera, viewmats=viewmats), depth="expected", **rest, group=ranks.group))

    compiled = torch.compile(image, fullgraph=True, backend="aot_eager")
    for shift in (0.0, -0.7):
        arguments, camera = shards.of(ranks.rank)
        means = arguments.pop("means") + shift
        found = []
        for function in (image, compiled):
            m, v = leaves(means, camera.viewmats)
            values = function(m, v, arguments, camera)
            found.append([*values, *torch.autograd.grad(values[0].square().sum() + values[2].sum(), [m, v])])
        assert_same_bits(*found)


def check_differences_are_errors_in_compiled_code(ranks: Ranks) -> None:
    arguments = scenes.splats(10)._asdict()
    width = 25 if ranks.rank == ranks.count - 1 else 24
    compiled = torch.compile(lambda camera: rasterize(camera=camera, **arguments, group=ranks.group).image, fullgraph=True, backend="aot_eager")
    expect(RuntimeError, "the ranks of the group differ", lambda: compiled(scenes.camera(2, width, 17)))
    compare(ranks, shards_of(ranks, 2))
