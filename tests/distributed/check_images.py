"""Images and gradients of ranks are those of one process."""

from __future__ import annotations

import importlib.util
from typing import Any

import scenes
import torch
import torch.distributed as dist
from backends import KERNELS
from compare import assert_close, assert_same_bits, leaves
from ranks import Ranks, expect
from shards import Shards, compare, outputs, render, shards_of
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from tsplat import Camera, rasterize


def check_random_scenes(ranks: Ranks) -> None:
    for seed in range(16):
        try:
            compare(ranks, shards_of(ranks, seed))
        except AssertionError as error:
            raise AssertionError(f"seed {seed}: {error}") from error


def check_ranks_without_splats(ranks: Ranks) -> None:
    for empty in range(ranks.count):
        compare(ranks, shards_of(ranks, 100 + empty, sizes=[0 if r == empty else 20 for r in range(ranks.count)]))
    compare(ranks, shards_of(ranks, 99, sizes=[0] * ranks.count))


def check_ranks_with_nothing_visible(ranks: Ranks) -> None:
    """Behind all cameras; and, of the last rank, cameras that look away from everything."""
    shards = shards_of(ranks, 7, sizes=[15] * ranks.count)
    shards.shared["means"][shards.part(0)[0]] *= -1
    compare(ranks, shards)
    shards.camera.viewmats[shards.part(ranks.count - 1)[1], 2, 3] -= 1000
    compare(ranks, shards)


def check_what_travels(ranks: Ranks) -> None:
    """Of each visible splat 7 numbers and its colour, there and back; no SH coefficients, and the depth only once; with absgrad 2 more."""
    class Widths(TorchDispatchMode):
        def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            if "all_to_all_single" in function.name() and args[0].dtype == torch.float64 and args[0].ndim == 2:
                widths.append(args[0].shape[1])
            return function(*args, **(kwargs or {}))

    arguments = scenes.splats(10)._asdict() | {"colors": scenes.sh_coefficients(10, 3)}
    inputs = leaves(*arguments.values())
    for absgrad, width in ((None, 10), (torch.zeros(ranks.count, 10, 2, dtype=torch.float64, requires_grad=True), 12)):
        widths: list[int] = []
        with Widths():
            rasterize(**dict(zip(arguments, inputs, strict=True)), camera=scenes.camera(), sh_degree=3, depth="expected", absgrad=absgrad,
                      group=ranks.group).image.sum().backward()
        assert widths[1:] == [width, width], widths             # the first: what the ranks compare


def check_what_is_recorded(ranks: Ranks) -> None:
    """For backward, of splats of which each camera sees 1 in 40: nothing of a row per splat, let alone one for each camera and splat."""
    arguments, camera = scenes.splats(800)._asdict() | {"colors": scenes.sh_coefficients(800, 3)}, scenes.camera(2)
    arguments["means"][:, 0] += 50.0 * (torch.arange(800) % 40)
    inputs, shapes = leaves(*arguments.values()), []

    def noted(tensor: Tensor) -> Tensor:
        shapes.append(tensor.shape)
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(noted, lambda tensor: tensor):
        rendering = rasterize(**dict(zip(arguments, inputs, strict=True)), camera=camera, sh_degree=3, group=ranks.group)
    assert 0 < len(rendering.meta.visible_ids) <= 20 * 2 * ranks.count
    assert max(max(shape, default=0) for shape in shapes) < 800, shapes
    rendering.image.sum().backward()                            # as all ranks do


def check_equal_depths(ranks: Ranks) -> None:
    """The order is that of the ranks, then that of the splats."""
    n = 12
    splats = scenes.splats(n * ranks.count, depth=(3.0, 3.0), size=(0.3, 0.6), spread=0.5)
    camera = scenes.camera(ranks.count, turn=0.0)
    compare(ranks, Shards([n] * ranks.count, 1, camera, splats._asdict()))


def check_splats_that_are_not_finite(ranks: Ranks) -> None:
    shards = shards_of(ranks, 5, sizes=[12] * ranks.count)
    shards.shared["means"][::5] = torch.nan
    (shards.shared | shards.views)["colors"][..., 1::5, 0] = torch.inf
    compare(ranks, shards)


def check_on_the_kernels(ranks: Ranks) -> None:
    """What arrives is laid out in another way than what projection gives."""
    if KERNELS.name == "interpreter" and importlib.util.find_spec("triton") is not None:
        shards = Shards([3] * ranks.count, 2, scenes.camera(2 * ranks.count, 8, 8), scenes.splats(3 * ranks.count, spread=0.8)._asdict())
        with KERNELS.active():
            compare(ranks, shards)


def check_float32(ranks: Ranks) -> None:
    """Images to 4 eps."""
    shards = Shards([10] * ranks.count, 2, scenes.camera(2 * ranks.count).to(torch.float32),
                    {k: v.float() for k, v in scenes.splats(10 * ranks.count)._asdict().items()})
    whole = rasterize(camera=shards.camera, **shards.shared).image
    arguments, camera = shards.of(ranks.rank)
    got = rasterize(camera=camera, **arguments, group=ranks.group).image
    assert got.dtype == torch.float32
    assert_close(got, whole[shards.part(ranks.rank)[1]], 4 * torch.finfo(torch.float32).eps)


def check_gradients_of_the_means_on_screen(ranks: Ranks) -> None:
    """`meta.means2d.retain_grad()` gives the owner that of the images of all ranks: what `screen_offset` gets."""
    shards = shards_of(ranks, 11, sizes=[20] * ranks.count)
    shards.views["screen_offset"] = torch.zeros(len(shards.camera), sum(shards.sizes), 2, dtype=torch.float64)
    arguments, camera = shards.of(ranks.rank)
    offset = arguments.pop("screen_offset").requires_grad_()
    rendering, _ = render(arguments, camera, shards.options | {"group": ranks.group, "screen_offset": offset})
    rendering.meta.means2d.retain_grad()
    rendering.image.square().sum().backward()
    assert torch.equal(rendering.meta.means2d.grad, offset.grad[rendering.meta.visible])
    assert (offset.grad[rendering.meta.visible] != 0).any()
    assert (offset.grad[~rendering.meta.visible] == 0).all()


def check_a_loop_is_that_of_one_process(ranks: Ranks) -> None:
    """The loop that `tsplat.distributed` prints, five steps of it: splats end where one process moves them."""
    shards = Shards([8] * ranks.count, 2, scenes.camera(2 * ranks.count), scenes.splats(8 * ranks.count)._asdict())
    photos = scenes.uniform(0.0, 1.0, 2 * ranks.count, 17, 24, 3, seed=scenes.generator(5))
    splats, cameras = shards.part(ranks.rank)

    def train(arguments: dict[str, Tensor], camera: Camera, photos: Tensor, **options: Any) -> list[Tensor]:
        inputs = leaves(*arguments.values())
        optimiser = torch.optim.SGD(inputs, 0.5)
        for _ in range(5):
            image = rasterize(**dict(zip(arguments, inputs, strict=True)), camera=camera, **options).image
            optimiser.zero_grad()
            ((image - photos).square().mean() / (options["group"].size() if options else 1)).backward()
            optimiser.step()
        return inputs

    whole = train(shards.shared, shards.camera, photos)
    assert (whole[0] - shards.shared["means"]).abs().max() > 1e-3
    assert_close(train(*shards.of(ranks.rank), photos[cameras], group=ranks.group), [v[splats] for v in whole], 1e-12)


def check_second_derivatives(ranks: Ranks) -> None:
    """Of the sum of squares of the gradients of the means."""
    shards = Shards([10] * ranks.count, 1, scenes.camera(ranks.count), scenes.splats(10 * ranks.count)._asdict())

    def twice(arguments: dict[str, Tensor], camera: Camera, **options: Any) -> list[Tensor]:
        rendering, inputs = render(arguments, camera, options)
        v_means, = torch.autograd.grad(rendering.image.square().sum(), inputs[:1], create_graph=True)
        return list(torch.autograd.grad(v_means.square().sum(), inputs[:4]))

    whole = twice(shards.shared, shards.camera)
    part = twice(*shards.of(ranks.rank), group=ranks.group)
    assert_close(part, [v[shards.part(ranks.rank)[0]] for v in whole], 1e-10)


def check_one_rank_is_as_none(ranks: Ranks) -> None:
    """A group of one process is like no group, to the bit, with gradients."""
    alone = [dist.new_group([r]) for r in range(ranks.count)][ranks.rank]
    shards = shards_of(ranks, 3)
    whole = shards.shared | shards.views | shards.own, shards.camera
    found = []
    for options in ({}, {"group": alone}):
        rendering, inputs = render(*whole, shards.options | options)
        found.append([*outputs(rendering), *torch.autograd.grad(rendering.image.square().sum(), inputs, materialize_grads=True)])
    assert_same_bits(*found)


def check_groups_of_some_of_the_ranks(ranks: Ranks) -> None:
    """Ranks count within the group; the others get an error."""
    some = list(range(1, ranks.count)) if ranks.count > 2 else [1, 0]
    group = dist.new_group(some)
    if ranks.rank in some:
        inner = Ranks(dist.get_rank(group), len(some), group)
        compare(inner, shards_of(inner, 21))
    else:
        arguments, camera = shards_of(ranks, 21).of(ranks.rank)
        expect(TypeError, "group: expected", lambda: rasterize(camera=camera, **({"quats": None, "scales": None} | arguments), group=group))


def check_without_gradients(ranks: Ranks) -> None:
    shards = Shards([10] * ranks.count, 1, scenes.camera(ranks.count), scenes.splats(10 * ranks.count)._asdict())
    arguments, camera = shards.of(ranks.rank)
    with torch.no_grad():
        want = rasterize(camera=shards.camera, **shards.shared).image[ranks.rank]
        assert_close(rasterize(camera=camera, **arguments, group=ranks.group).image[0], want, 1e-14)
