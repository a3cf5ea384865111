"""Fits over several ranks, against one process that does the same."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed as dist
from compare import assert_close, assert_same_bits
from ranks import Ranks, expect
from torch import Tensor

import tsplat.fit.trainer
from tsplat.fit import FitConfig, Step, evaluate, fit
from tsplat.fit.checkpoint import read_checkpoint, restore, save_checkpoint
from tsplat.fit.density import Budget, Schedule
from tsplat.fit.losses import photo_loss, scene_regulariser, target_of
from tsplat.fit.optimiser import learning_rates, make_adam, set_rates
from tsplat.fit.ranks import ALONE, even
from tsplat.fit.ranks import Ranks as FitRanks
from tsplat.fit.shards import map_rows, moves
from tsplat.fit.state import FitState
from tsplat.fit.trainer import start, train_step
from tsplat.scene import Capture, Gaussians, load_capture

CPU = torch.device("cpu")


def capture_of(ranks: Ranks) -> Capture:
    """8 photos of 32x24 with 200 points; photos 0 and 4 are held out."""
    capture = load_capture(ranks.folder / "capture", test_every=4)
    assert capture.points is not None
    assert capture.point_colors is not None
    capture.points, capture.point_colors = capture.points[:200], capture.point_colors[:200]
    return capture


def config_of(**changes: Any) -> FitConfig:
    return FitConfig(**{"steps": 30, "splats": 200, "test_every": 4, "checkpoint_every": 10, "density_start": 0.1, "density_every": 6,
                        "density_stop": 0.9, **changes})


def shared_folder(ranks: Ranks, name: str) -> Path:
    return ranks.folder / name


def rows_of(state: FitState) -> dict[str, Tensor]:
    """All rows of the splats of all ranks, by name."""
    rows: dict[str, Tensor] = {}
    map_rows(state.state_dict(), lambda name, value: rows.setdefault(name, state.ranks.gather(value)[0].clone()))
    return rows


def check_steps_are_those_of_one_process(ranks: Ranks) -> None:
    """Of one that adds up the gradients of as many photos, divided by their number, in float64: 1e-9, for sums in another order through 4 steps of
    Adam, which divides gradients by their size."""
    capture, fit_ranks = capture_of(ranks), FitRanks(ranks.group)
    config = config_of(density="adaptive", density_start=0.9, reset_every=0, exposure=True, refine_poses=True, opacity_reg=0.02, scale_reg=0.03,
                       opacity_depth_reg=0.01, sh_warmup=0.0, sh_degree=1, lr_exposure=1e-2, lr_poses=1e-2)
    torch.set_default_dtype(torch.float64)
    try:
        capture.viewmats, capture.Ks = capture.viewmats.double(), capture.Ks.double()
        capture.points, capture.point_colors = capture.points.double(), capture.point_colors.double()      # type: ignore[union-attr]
        state, whole = start(capture, config, CPU, fit_ranks), start(capture, config, CPU)
        own = fit_ranks.gather(torch.zeros(len(state.gaussians)))[1]
        stretch(whole.gaussians, slice(None))
        stretch(state.gaussians, own)
        adam = make_adam(whole.gaussians)
        for _ in range(4):
            step = train_step(state, capture, config)
            loss = accumulated_step(whole, adam, capture, config, ranks.count)
            assert step.loss == pytest.approx(loss, rel=1e-9)
            fit_ranks.local(whole.generator)               # which draws a number
    finally:
        torch.set_default_dtype(torch.float32)
    assert (state.step, state.queue) == (whole.step, whole.queue)
    for name, value in whole.gaussians.named_parameters():
        assert_close(state.gaussians.get_parameter(name).detach(), value.detach()[own], 1e-9)
    for name, value in whole.photos.named_parameters():
        assert float(value.detach().abs().max()) > 1e-3
        assert_close(state.photos.get_parameter(name).detach(), value.detach(), 1e-9)
    found, wanted = state.control.state_dict()["gradients"], whole.control.state_dict()["gradients"]
    assert float(wanted["total"].max()) > 0
    assert_close([found["total"], found["views"]], [wanted["total"][own], wanted["views"][own]], 1e-9)


@torch.no_grad()
def stretch(scene: Gaussians, own: slice) -> None:
    """Make round splats long: the gradient of a rotation that does nothing is what rounding leaves, which Adam takes for a direction."""
    scene.log_scales += torch.linspace(-1, 1, 600).view(200, 3)[own]


def accumulated_step(state: FitState, adam: Any, capture: Capture, config: FitConfig, count: int) -> float:
    """A step of `count` photos, one after another, on the whole scene; the mean of their losses."""
    scene, photos, losses = state.gaussians, state.photos, []
    adam.zero_grad()
    photos.zero_grad()
    views = [state.next_view(capture.train) for _ in range(count)]
    for view in views:
        camera = photos.camera(capture.camera(view), view, capture.extent)
        target = target_of(capture.images[view], torch.zeros(3), masked=False)
        probes = state.control.probes(scene, 1)
        rendering = tsplat.fit.draw(scene, camera, torch.zeros(3), probes=probes)
        loss = photo_loss(photos.expose(rendering.image, view), target, config.ssim_weight)
        terms = scene_regulariser(scene.opacities, scene.scales, rendering.meta, capture.extent, opacity=0.02, scale=0.03, opacity_depth=0.01)
        assert terms is not None
        (loss + terms).backward()                           # type: ignore[no-untyped-call]
        state.control.observe(rendering.meta, camera)
        losses.append(float((loss + terms).detach()))
    for parameter in (*scene.parameters(), *photos.parameters()):
        parameter.grad /= count
    rates = {name: rate * count**0.5 for name, rate in learning_rates(config_of(steps=30_000), capture.extent, 0).items()}
    decay = config.lr_means_decay ** (state.step / (config.steps - 1))
    cap = min(6.0, (30_000 / config.steps * count) ** 0.5) / count**0.5
    set_rates(adam, {name: cap * rate * (decay if name == "means" else 1.0) for name, rate in rates.items()})
    for group in adam.param_groups:
        group["betas"] = 0.9**count, 0.999**count
    adam.step()
    photos.step(views, config, state.step)
    state.step += count
    return sum(losses) / count


def check_the_budget_is_that_of_one_process(ranks: Ranks) -> None:
    """The same splats go and are cloned, to the bit, from uneven ranks; in all as many as asked for."""
    fit_ranks, generator = FitRanks(ranks.group), torch.Generator().manual_seed(1)
    n = 60
    scene = Gaussians.random(n, sh_degree=0, generator=generator)
    with torch.no_grad():
        scene.opacity_logits.copy_(torch.randn(n, generator=generator) - 4)         # some are faint
    total, views = torch.rand(n, generator=generator), torch.randint(0, 3, (n,), generator=generator).float()
    sizes = [40, 20] if ranks.count == 2 else [5, 55, 0]
    begin = sum(sizes[:ranks.rank])
    own = slice(begin, begin + sizes[ranks.rank])
    found = []
    for members, part in ((ALONE, slice(0, n)), (fit_ranks, own)):
        some = Gaussians(**{name: value[part] for name, value in scene.state_dict().items()})
        control = Budget(1e9, Schedule(1, 3, 1), 300, ranks=members)                # everything is small: clones
        for step in (1, 2):
            control.gradients.total, control.gradients.views = total[part], views[part]
            if step == 2:                                                           # scores that follow the splats
                control.gradients.total, control.gradients.views = some.means.detach()[:, 0].abs(), torch.ones(len(some))
            control.update(some, make_adam(some), step, torch.Generator())
        gathered = members.gather(some.means.detach()[:, 0].contiguous())[0]
        assert len(gathered) == 300
        found.append(gathered.sort().values)
    assert_same_bits(*found)


def check_splats_move_with_all_that_is_known_of_them(ranks: Ranks) -> None:
    """Nothing changes but who has them: every row is as it was, in its order, and so is the image."""
    capture, config, fit_ranks = capture_of(ranks), config_of(sh_warmup=0.0, density_start=0.9), FitRanks(ranks.group)
    state = start(capture, config, CPU, fit_ranks)
    for _ in range(2):
        train_step(state, capture, config)
    uneven = [190, 10] if ranks.count == 2 else [0, 150, 50]
    before, image, had = rows_of(state), view_of(state, capture), fit_ranks.sizes(len(state.gaussians))
    assert len(before) == 6 * 3 + 2                        # parameters and two moments of each; gradients and views
    moved = map_rows(state.state_dict(), lambda _, rows: fit_ranks.moved(rows, had, uneven))
    state = FitState.from_state_dict(moved, capture, config, CPU, fit_ranks)
    assert fit_ranks.sizes(len(state.gaussians)) == uneven
    assert moves(uneven)
    assert_same_bits(list(rows_of(state).values()), list(before.values()))
    assert_close(view_of(state, capture), image, 1e-6)     # float32
    state.rebalance(uneven, capture, config)
    assert fit_ranks.sizes(len(state.gaussians)) == even(200, ranks.count) == had
    assert not moves(had)
    assert_same_bits(list(rows_of(state).values()), list(before.values()))
    assert_close(view_of(state, capture), image, 1e-6)
    chunk, tsplat.fit.ranks.CHUNK = tsplat.fit.ranks.CHUNK, 7
    scene = state.whole_scene(config)
    tsplat.fit.ranks.CHUNK = chunk
    assert_same_bits(list(scene.state_dict().values()), [before[f"gaussians/{name}"] if ranks.rank == 0 else value.detach()
                                                         for name, value in state.gaussians.named_parameters()])
    train_step(state, capture, config)
    assert list(state.adam.state) == list(state.gaussians.parameters())


def view_of(state: FitState, capture: Capture) -> Tensor:
    with torch.no_grad():
        return tsplat.fit.draw(state.gaussians, capture.camera(0), group=state.ranks.group).image


def check_checkpoints_load_on_any_number_of_ranks(ranks: Ranks) -> None:
    """On as many ranks, on fewer, on one; and that of one on all."""
    capture, config, fit_ranks = capture_of(ranks), config_of(), FitRanks(ranks.group)
    path = shared_folder(ranks, "world") / "checkpoint.pt"
    path.parent.mkdir(exist_ok=True)
    state = start(capture, config, CPU, fit_ranks)
    for _ in range(4):
        train_step(state, capture, config)
    save_checkpoint(path, state, config, capture)
    wanted = rows_of(state)
    few = list(range(ranks.count - 1))
    group = dist.new_group(few)
    loaders = [fit_ranks, ALONE] + ([FitRanks(group)] if ranks.rank in few else [])
    for loader in loaders:
        loaded = restore(path, read_checkpoint(path), config, capture, CPU, loader)
        assert_same_bits(list(rows_of(loaded).values()), list(wanted.values()))
        assert (loaded.step, loaded.queue, loaded.history.rows) == (state.step, state.queue, state.history.rows)
    dist.barrier()
    alone = restore(path, read_checkpoint(path), config, capture, CPU)
    if ranks.rank == 0:
        save_checkpoint(path.with_name("one.pt"), alone, config, capture)
    dist.barrier()
    spread = restore(path.with_name("one.pt"), read_checkpoint(path.with_name("one.pt")), config, capture, CPU, fit_ranks)
    assert fit_ranks.sizes(len(spread.gaussians)) == even(200, ranks.count)
    assert_same_bits(list(rows_of(spread).values()), list(wanted.values()))
    dist.barrier()
    if ranks.rank == 0:
        for file in (path.parent / "checkpoint.pt.0").glob("*.distcp"):
            file.write_bytes(file.read_bytes()[:100])
    dist.barrier()
    expect(ValueError, f"{path}.0: expected the splats of the checkpoint checkpoint.pt; rank 0: ",
           lambda: restore(path, read_checkpoint(path), config, capture, CPU, fit_ranks))
    dist.barrier()
    if ranks.rank == 0:
        shutil.rmtree(f"{path}.0")
    dist.barrier()
    expect(ValueError, f"{path}.0: expected the splats of the checkpoint checkpoint.pt; the folder is not there",
           lambda: restore(path, read_checkpoint(path), config, capture, CPU, fit_ranks))


def check_a_fit_ends_the_same_after_an_interruption(ranks: Ranks) -> None:
    """Ctrl-C on one rank only, amid density control: all stop, with a checkpoint, and what goes on from it gives the same bits. The budget is met."""
    capture, out = capture_of(ranks), shared_folder(ranks, "fit")
    config = config_of(max_splats=333, exposure=True, refine_poses=True, pose_steps=1)
    straight = fit(capture, config, out / "straight", progress=False, group=ranks.group)

    def press(step: Step) -> None:
        if step.number >= 15 and ranks.rank == 1:
            os.kill(os.getpid(), signal.SIGINT)

    expect(KeyboardInterrupt, "stopped after step 1", lambda: fit(   # type: ignore[arg-type]
        capture, config, out / "stopped", progress=False, callbacks=[press], group=ranks.group))
    numbers: list[int] = []
    resumed = fit(capture, config, out / "stopped", progress=False, callbacks=[lambda step: numbers.append(step.number)], group=ranks.group)
    assert 15 < numbers[0] < 22
    assert (resumed.qualities, resumed.refined) == (straight.qualities, straight.refined)
    assert list(straight.qualities) == [capture.names[i] for i in capture.test]
    if ranks.rank == 0:
        assert len(straight.gaussians) == 333
        alone = evaluate(straight.gaussians, capture, capture.test, config)                # 2 photos, of 2 or 3 ranks
        for name, quality in alone.items():
            assert straight.qualities[name] == pytest.approx(quality, rel=1e-5)             # float32, sums in another order
        assert (out / "stopped" / "scene.ply").read_bytes() == (out / "straight" / "scene.ply").read_bytes()
        names = {"checkpoint.pt", "config.json", "contact.png", "curves.png", "metrics.json", "scene.ply", "test"}
        assert {path.name for path in (out / "stopped").iterdir()} - names in ({"checkpoint.pt.0"}, {"checkpoint.pt.1"})
        assert len(list((out / "straight" / "test").iterdir())) == 2


def check_kinds_of_density_control(ranks: Ranks) -> None:
    """Adaptive control and MCMC end within their numbers, on ranks that stay even."""
    capture = capture_of(ranks)
    for changes, most in (({"density": "adaptive", "density_threshold": 1e-5, "max_splats": 280, "reset_every": 9000}, 280),
                          ({"density": "mcmc", "max_splats": 215, "optimiser": "visible"}, 215)):
        sizes: list[int] = []
        fit(capture, config_of(**changes), progress=False, callbacks=[lambda step: sizes.append(len(step.gaussians))], group=ranks.group)   # noqa: B023
        everyone = FitRanks(ranks.group).sizes(sizes[-1])
        assert 200 < sum(everyone) <= most
        assert not moves(everyone)
        assert max(FitRanks(ranks.group).total(size) for size in sizes) <= most


def check_errors_are_on_all_ranks(ranks: Ranks) -> None:
    """A loss that is not finite on one rank ends all before the step, with a checkpoint."""
    capture, config, out = capture_of(ranks), config_of(), shared_folder(ranks, "failed")
    loss, last = tsplat.fit.trainer.photo_loss, ranks.rank == ranks.count - 1
    calls: list[int] = []

    def spoilt(*args: Any) -> Tensor:
        calls.append(1)
        return loss(*args) * (float("inf") if len(calls) == 3 and last else 1.0)

    tsplat.fit.trainer.photo_loss = spoilt
    try:
        expect(FloatingPointError, f"step {3 * ranks.count}, photo view_00", lambda: fit(capture, config, out, progress=False, group=ranks.group))
    finally:
        tsplat.fit.trainer.photo_loss = loss
    assert read_checkpoint(out / "checkpoint.pt")["state"]["step"] == 2 * ranks.count
    numbers: list[int] = []
    fit(capture, config, out, progress=False, callbacks=[lambda step: numbers.append(step.number)], group=ranks.group)
    assert numbers[0] == 3 * ranks.count


def check_what_several_ranks_cannot(ranks: Ranks) -> None:
    capture = capture_of(ranks)
    run: Callable[..., Any] = lambda **changes: fit(capture, config_of(**changes), progress=False, group=ranks.group)      # noqa: E731
    expect(NotImplementedError, "primitive: expected 'gaussians' with more than one process", lambda: run(primitive="spheres"))
    expect(NotImplementedError, "offload: expected False with more than one process", lambda: run(offload=True))
    expect(NotImplementedError, "video: expected 0 with more than one process; got 3", lambda: run(video=3))
    capture.width[2] = 31
    expect(ValueError, "data: expected photos of one size with more than one process; got 2 sizes: 31x24, 32x24", run)
