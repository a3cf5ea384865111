"""What each rank checks. Every rank also computes the whole by itself, as one process does, and compares its part."""

from __future__ import annotations

import dataclasses
import datetime
import random
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import scenes
import torch
import torch.distributed as dist
from compare import assert_close, assert_same_bits, leaves
from torch import Tensor

import tsplat
from tsplat import Camera, Rendering, rasterize

CHECKS: list[Callable[[Any], None]] = []


def check(function: Callable[[Any], None]) -> Callable[[Any], None]:
    """A check that all ranks run."""
    CHECKS.append(function)
    return function


@dataclasses.dataclass
class Ranks:
    """Where this process is."""

    rank: int
    count: int
    group: Any


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
    for name in ("means2d", "depths"):
        assert_close(getattr(part.meta, name), getattr(whole.meta, name)[:, splats], 1e-14)
    assert_same_bits([part.meta.radii, part.meta.hits, part.meta.visible_ids],
                     [whole.meta.radii[:, splats], whole.meta.hits[cameras], whole.meta.visible[:, splats].nonzero()])
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


@check
def random_scenes(ranks: Ranks) -> None:
    for seed in range(24):
        try:
            compare(ranks, shards_of(ranks, seed))
        except AssertionError as error:
            raise AssertionError(f"seed {seed}: {error}") from error


@check
def ranks_without_splats(ranks: Ranks) -> None:
    for empty in range(ranks.count):
        compare(ranks, shards_of(ranks, 100 + empty, sizes=[0 if r == empty else 20 for r in range(ranks.count)]))
    compare(ranks, shards_of(ranks, 99, sizes=[0] * ranks.count))


@check
def ranks_with_nothing_visible(ranks: Ranks) -> None:
    """Behind all cameras; and, of the last rank, cameras that look away from everything."""
    shards = shards_of(ranks, 7, sizes=[15] * ranks.count)
    shards.shared["means"][shards.part(0)[0]] *= -1
    compare(ranks, shards)
    shards.camera.viewmats[shards.part(ranks.count - 1)[1], 2, 3] -= 1000
    compare(ranks, shards)


@check
def equal_depths(ranks: Ranks) -> None:
    """The order is that of the ranks, then that of the splats."""
    n = 12
    splats = scenes.splats(n * ranks.count, depth=(3.0, 3.0), size=(0.3, 0.6), spread=0.5)
    camera = scenes.camera(ranks.count, turn=0.0)
    compare(ranks, Shards([n] * ranks.count, 1, camera, splats._asdict()))


@check
def splats_that_are_not_finite(ranks: Ranks) -> None:
    shards = shards_of(ranks, 5, sizes=[12] * ranks.count)
    shards.shared["means"][::5] = torch.nan
    (shards.shared | shards.views)["colors"][..., 1::5, 0] = torch.inf
    compare(ranks, shards)


@check
def float32(ranks: Ranks) -> None:
    """Images to 4 eps."""
    shards = Shards([10] * ranks.count, 2, scenes.camera(2 * ranks.count).to(torch.float32),
                    {k: v.float() for k, v in scenes.splats(10 * ranks.count)._asdict().items()})
    whole = rasterize(camera=shards.camera, **shards.shared).image
    arguments, camera = shards.of(ranks.rank)
    got = rasterize(camera=camera, **arguments, group=ranks.group).image
    assert got.dtype == torch.float32
    assert_close(got, whole[shards.part(ranks.rank)[1]], 4 * torch.finfo(torch.float32).eps)


@check
def gradients_of_the_means_on_screen(ranks: Ranks) -> None:
    """`meta.means2d.retain_grad()` gives the owner that of the images of all ranks: what `screen_offset` gets."""
    shards = shards_of(ranks, 11, sizes=[20] * ranks.count)
    shards.views["screen_offset"] = torch.zeros(len(shards.camera), sum(shards.sizes), 2, dtype=torch.float64)
    arguments, camera = shards.of(ranks.rank)
    offset = arguments.pop("screen_offset").requires_grad_()
    rendering, _ = render(arguments, camera, shards.options | {"group": ranks.group, "screen_offset": offset})
    rendering.meta.means2d.retain_grad()
    rendering.image.square().sum().backward()
    assert torch.equal(rendering.meta.means2d.grad, offset.grad)
    assert (offset.grad[rendering.meta.visible] != 0).any()
    assert (offset.grad[~rendering.meta.visible] == 0).all()


@check
def second_derivatives(ranks: Ranks) -> None:
    """Of the sum of squares of the gradients of the means."""
    shards = Shards([10] * ranks.count, 1, scenes.camera(ranks.count), scenes.splats(10 * ranks.count)._asdict())

    def twice(arguments: dict[str, Tensor], camera: Camera, **options: Any) -> list[Tensor]:
        rendering, inputs = render(arguments, camera, options)
        v_means, = torch.autograd.grad(rendering.image.square().sum(), inputs[:1], create_graph=True)
        return list(torch.autograd.grad(v_means.square().sum(), inputs[:4]))

    whole = twice(shards.shared, shards.camera)
    part = twice(*shards.of(ranks.rank), group=ranks.group)
    assert_close(part, [v[shards.part(ranks.rank)[0]] for v in whole], 1e-10)


@check
def one_rank_is_as_none(ranks: Ranks) -> None:
    """A group of one process is like no group, to the bit, with gradients."""
    alone = [dist.new_group([r]) for r in range(ranks.count)][ranks.rank]
    shards = shards_of(ranks, 3)
    whole = shards.shared | shards.views | shards.own, shards.camera
    found = []
    for options in ({}, {"group": alone}):
        rendering, inputs = render(*whole, shards.options | options)
        found.append([*outputs(rendering), *torch.autograd.grad(rendering.image.square().sum(), inputs, materialize_grads=True)])
    assert_same_bits(*found)


@check
def groups_of_some_of_the_ranks(ranks: Ranks) -> None:
    """Ranks count within the group; the others get an error."""
    some = list(range(1, ranks.count)) if ranks.count > 2 else [1, 0]
    group = dist.new_group(some)
    if ranks.rank in some:
        inner = Ranks(dist.get_rank(group), len(some), group)
        compare(inner, shards_of(inner, 21))
    else:
        arguments, camera = shards_of(ranks, 21).of(ranks.rank)
        expect(TypeError, "group: expected", lambda: rasterize(camera=camera, **({"quats": None, "scales": None} | arguments), group=group))


@check
def without_gradients(ranks: Ranks) -> None:
    shards = Shards([10] * ranks.count, 1, scenes.camera(ranks.count), scenes.splats(10 * ranks.count)._asdict())
    arguments, camera = shards.of(ranks.rank)
    with torch.no_grad():
        want = rasterize(camera=shards.camera, **shards.shared).image[ranks.rank]
        assert_close(rasterize(camera=camera, **arguments, group=ranks.group).image[0], want, 1e-14)


@check
def compiled_whole(ranks: Ranks) -> None:
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


def expect(kind: type[Exception], text: str, call: Callable[[], object]) -> None:
    """An error of this kind that begins with the text."""
    try:
        call()
    except kind as error:
        assert str(error).startswith(text), f"{error!r}, expected {text!r}"
        return
    raise AssertionError(f"no error, expected {kind.__name__}: {text}")


@check
def differences_between_ranks_are_errors_on_all(ranks: Ranks) -> None:
    """Nobody waits for ever, and the group works afterwards."""
    last = ranks.count - 1
    odd = ranks.rank == last
    base = {k: v[:10] for k, v in scenes.splats(10)._asdict().items()}
    camera = scenes.camera(2, 24, 17)

    def differ(text: str, camera: Camera = camera, arguments: dict[str, Tensor] = base, **options: Any) -> None:
        expect(ValueError, text.replace("LAST", f"rank {last}"), lambda: rasterize(camera=camera, **arguments, group=ranks.group, **options))

    end = "expected the same on all ranks of the group; got"
    differ(f"number of cameras: {end} 2 on rank 0 and 1 on LAST", camera[:1] if odd else camera)
    differ(f"number of cameras: {end} 2 on rank 0 and 1 on LAST", camera[0] if odd else camera)
    differ(f"camera.width: {end} 24 on rank 0 and 25 on LAST", scenes.camera(2, 25, 17) if odd else camera)
    differ(f"camera.height: {end} 17 on rank 0 and 18 on LAST", scenes.camera(2, 24, 18) if odd else camera)
    differ(f"camera.model (of pinhole, orthographic, fisheye): {end} 0 on rank 0 and 2 on LAST",
           dataclasses.replace(camera, model="fisheye") if odd else camera)
    differ(f"camera.near: {end} 0.01 on rank 0 and 1 on LAST", dataclasses.replace(camera, near=1.0) if odd else camera)
    differ(f"camera.far: {end} 1e+10 on rank 0 and 9 on LAST", dataclasses.replace(camera, far=9.0) if odd else camera)
    differ(f"antialiased: {end} 0 on rank 0 and 1 on LAST", antialiased=odd)
    differ(f"eps2d: {end} 0.3 on rank 0 and 0.1 on LAST", eps2d=0.1 if odd else 0.3)
    differ(f"channels of colors: {end} 3 on rank 0 and 2 on LAST", arguments=base | {"colors": base["colors"][:, :2 if odd else 3]})
    differ(f"absgrad (1: given): {end} 0 on rank 0 and 1 on LAST",
           absgrad=torch.zeros(2 * ranks.count, 10, 2, dtype=torch.float64) if odd else None)
    differ(f"requires_grad of the splats (1: yes, 0: no or no_grad): {end} 0 on rank 0 and 1 on LAST",
           arguments=base | {"means": base["means"].clone().requires_grad_(odd)})
    differ(f"requires_grad of the cameras (1: yes, 0: no or no_grad): {end} 0 on rank 0 and 1 on LAST",
           dataclasses.replace(camera, viewmats=camera.viewmats.clone().requires_grad_(odd)))
    single = torch.float32 if odd else torch.float64
    differ(f"dtype (bits of a number): {end} 64 on rank 0 and 32 on LAST", camera.to(single), {k: v.to(single) for k, v in base.items()})
    with torch.set_grad_enabled(not odd):
        differ(f"requires_grad of the splats (1: yes, 0: no or no_grad): {end} 1 on rank 0 and 0 on LAST",
               arguments=base | {"means": base["means"].clone().requires_grad_()})
    compare(ranks, shards_of(ranks, 2))


@check
def differences_are_errors_in_compiled_code(ranks: Ranks) -> None:
    arguments = scenes.splats(10)._asdict()
    width = 25 if ranks.rank == ranks.count - 1 else 24
    compiled = torch.compile(lambda camera: rasterize(camera=camera, **arguments, group=ranks.group).image, fullgraph=True, backend="aot_eager")
    expect(RuntimeError, "the ranks of the group differ", lambda: compiled(scenes.camera(2, width, 17)))
    compare(ranks, shards_of(ranks, 2))


@check
def what_is_wrong_on_each_rank(ranks: Ranks) -> None:
    """Before anything is sent."""
    arguments, camera = scenes.splats(4)._asdict(), scenes.camera(2)
    expect(NotImplementedError, "capacity: expected None with a group", lambda: rasterize(camera=camera, **arguments, group=ranks.group, capacity=9))
    for name in ("screen_offset", "absgrad"):
        probe = {name: torch.zeros(2, 4, 2, dtype=torch.float64)}
        expect(ValueError, f"{name}: expected shape [{2 * ranks.count}, 4, 2]; got [2, 4, 2]",
               lambda probe=probe: rasterize(camera=camera, **arguments, group=ranks.group, **probe))  # type: ignore[misc]


def main() -> None:
    """An error ends this process, and the other ranks with it: they would wait for this one."""
    rank, count, folder = int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3])
    dist.init_process_group("gloo", init_method=f"file://{folder / 'store'}", rank=rank, world_size=count, timeout=datetime.timedelta(seconds=60))
    for function in CHECKS:
        torch.manual_seed(0)
        print(function.__name__, flush=True)            # the last line of a log is where it failed
        function(Ranks(rank, count, dist.group.WORLD))
    dist.destroy_process_group()


if __name__ == "__main__":
    main()
