"""`fit`: from posed photos to a scene (3DGS, sections 5 and 7.1). What it is made of, `primitive` knows."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from tsplat.camera import Camera
from tsplat.fit.checkpoint import restore, save_checkpoint
from tsplat.fit.config import FitConfig
from tsplat.fit.drawing import step_background
from tsplat.fit.evaluation import Quality, mean_quality, picture_name, scores
from tsplat.fit.interrupt import deferred_interrupt
from tsplat.fit.losses import Target, depth_loss, photo_loss, psnr, target_of
from tsplat.fit.memory import check_growth
from tsplat.fit.optimiser import adam_step, set_rates
from tsplat.fit.output import Output
from tsplat.fit.primitive import Scene, primitive_of
from tsplat.fit.progress import progress_line
from tsplat.fit.ranks import ALONE, Ranks, even
from tsplat.fit.report import write_sheet
from tsplat.fit.schedules import divisor_at, regulariser_weights
from tsplat.fit.shards import moves
from tsplat.fit.state import FitState
from tsplat.fit.stream import PhotoStream
from tsplat.fit.turntable import write_turntable
from tsplat.scene import Capture, load_capture

if TYPE_CHECKING:
    from torch.distributed import ProcessGroup  # some builds of torch have none


@dataclass(frozen=True)
class Step:
    """What a callback is told after each step.

    Args:
        number: steps done; of several ranks, photos.
        photo: its name; that of this rank.
        loss, psnr: of its render before the step (PSNR in dB); means over ranks.
        gaussians: the scene after the step; this rank's splats. A callback may look at it, not change it.
        settled: whether it can be judged: not so right after a reset of its opacities (`Control.settled`).
    """

    number: int
    photo: str
    loss: float
    psnr: float
    gaussians: Scene
    settled: bool = True


@dataclass(frozen=True)
class FitResult:
    """What a fit gives.

    Args:
        gaussians: the scene. Of several ranks, all of it, on the CPU, on rank 0, and the own part on the others.
        qualities: PSNR and SSIM of the held-out photos, by name.
        refined: the same with the poses of these photos refined, too, where the fit refined poses; else empty.
        seconds: wall time of the steps, also of those before an interruption.
    """

    gaussians: Scene
    qualities: dict[str, Quality]
    refined: dict[str, Quality]
    seconds: float

    @property
    def mean(self) -> Quality | None:
        """Mean quality, or None if no photo was held out."""
        return mean_quality(self.qualities)

    @property
    def refined_mean(self) -> Quality | None:
        """Mean quality with refined poses, or None without."""
        return mean_quality(self.refined)


def fit(data: Capture | str | os.PathLike[str], config: FitConfig | None = None, out: str | os.PathLike[str] | None = None, *,
        resume: bool = True, progress: bool = True, callbacks: Sequence[Callable[[Step], None]] = (),
        device: str | torch.device = "cpu", group: ProcessGroup | None = None) -> FitResult:
    """Fit a scene to photos: one photo per step, at random without replacement, Adam on L1 and SSIM, density control.

    **With a group** of K ranks, splats are sharded over them (`tsplat.distributed`), and a step takes K photos of the same order, one on each rank,
    and minimises their mean loss; a batch may have the end of one round of all photos and the begin of the next. All that counts steps goes on
    counting photos, so that the same config is the same fit in K times fewer steps: schedules stay, rates rise by sqrt(K) (`rate_factor`), betas are
    to the power of K (`set_rates`). When one rank has more than 1.1 times the mean number of splats, they are made even again. All photos need one
    size, and all ranks the same `out` on one file system.

    **Right after a reset** of the opacities (`AdaptiveControl`) a scene is not itself. It always has settled when the fit ends, so that what is
    scored and written is settled. Density control does not judge before, nor should callbacks (`Step.settled`), and no checkpoint is written that
    falls due meanwhile: instead there is one right before the reset, and one as soon as the scene has settled. So a killed fit loses at most
    `checkpoint_every` steps, or as many as a scene takes to settle, a sixtieth of all, where these are more. (Of several ranks, up to the photos of
    a step more.) What Ctrl-C and errors leave is the state of that moment, settled or not, from which the fit goes on to the same bits.

    Args:
        data: a capture, or the folder of one (see `load_capture`; `downscale` and `test_every` of the config apply to a
            folder only).
        config: default `FitConfig()`.
        out: a folder, made if need be, for `scene.ply`, `metrics.json`, `config.json`, `curves.png`, `test/<photo>.png` (held-out
            photo beside render), `contact.png` (some of these, with the error), `turntable.gif` (if asked for) and
            `checkpoint.pt`. Other files in it are left alone. None: nothing is written.
        resume: go on from the checkpoint in `out`, if there is one. A fit that was interrupted and resumed ends, on the same
            machine, with the same bits as one that was not.
        progress: show a line with loss, PSNR and number of splats.
        callbacks: each is called after each step; `tsplat.fit.to_writer` makes one for TensorBoard, `tsplat.viewer.page.training_page` one for a
            web page.
        device: where to compute. (The scene is in host memory with `config.offload`, else there.)
        group: of `torch.distributed`, all of whose ranks make the same call, each with its device. One of 1 rank is as None.

    Raises:
        ValueError, FileNotFoundError: bad data, no photo to train on, a checkpoint of another fit.
        FileExistsError: `out` holds a file of one of these names that is not from a fit.
        FloatingPointError: a loss or gradient that is not finite, naming the step, the photo and the parameter. The last
            checkpoint stays; if there is none yet, one is written.
        MemoryError: density control would take more memory than is free; before it does. As above.
        NotImplementedError: what a primitive does not have (depth maps for spheres), what several ranks do not (spheres, offloading, turntables).
        OSError: a file cannot be written. The last checkpoint stays.
        KeyboardInterrupt: on Ctrl-C, after the step and a checkpoint; its message says where it is.
    """
    config = config or FitConfig()
    device = torch.device(device)
    if isinstance(data, Capture):
        capture = data
    else:
        capture = load_capture(data, downscale=config.downscale, test_every=config.test_every)
    if not capture.train:
        raise ValueError(f"data: expected photos to train on; all {len(capture)} are held out (test_every = 0 holds out none)")
    ranks = Ranks(group, device)
    _check_ranks(capture, config, ranks)
    output = None if out is None else Output(Path(out))
    saved = None if output is None else output.open()
    if output is not None and saved is not None and resume:
        state = restore(output.checkpoint, saved, config, capture, device, ranks)
    else:
        state = start(capture, config, device, ranks)
    _train(state, capture, config, output, progress and ranks.rank == 0, callbacks)
    if output is not None:
        save_checkpoint(output.checkpoint, state, config, capture)
        output.pictures.mkdir(exist_ok=True)
    qualities, refined = scores(state.gaussians, capture, config, None if output is None else output.pictures, state.device, ranks)
    scene = state.whole_scene(config)
    if output is not None and ranks.rank == 0:
        output.write(scene, config, qualities, refined, state.seconds)
        state.history.write(output.curves)
        if qualities:
            write_sheet(output.sheet, [output.pictures / picture_name(name) for name in qualities])
        if config.video:
            write_turntable(output.turntable, scene, capture, config, config.video, state.device)
    return FitResult(scene, qualities, refined, state.seconds)


def start(capture: Capture, config: FitConfig, device: torch.device, ranks: Ranks = ALONE) -> FitState:
    """The state before the first step."""
    generator, primitive = torch.Generator().manual_seed(config.seed), primitive_of(config)
    scene = primitive.start(capture, config, generator)
    if ranks.count > 1:                                  # each has made all of it, from the same random numbers
        scene = primitive.load({name: rows.split(even(len(rows), ranks.count))[ranks.rank] for name, rows in scene.state_dict().items()})
    return FitState.of(scene, capture, config, generator, device, ranks)


def train_step(state: FitState, capture: Capture, config: FitConfig, images: PhotoStream | None = None) -> Step:
    """Render one photo's view (on each rank), compare, and move the parameters.

    Nothing has changed where it raises before they move: a photo that cannot be read, numbers that are not finite, too little memory.

    Args:
        state: of the fit.
        capture, config: which it was started with.
        images: to read the photos from, default those of the capture.

    Raises:
        FloatingPointError, MemoryError: see `fit`.
    """
    before = state.generator.get_state(), list(state.queue)
    try:
        return _step(state, capture, config, images)
    except Exception:
        state.generator.set_state(before[0])
        state.queue = before[1]
        raise


def _step(state: FitState, capture: Capture, config: FitConfig, images: PhotoStream | None) -> Step:
    scene, device, primitive, extent, ranks = state.gaussians, state.device, primitive_of(config), capture.extent, state.ranks
    number = state.step + ranks.count
    views = [state.next_view(capture.train) for _ in range(ranks.count)]
    view = views[ranks.rank]
    photo = (images or capture.images)[view].to(device)
    if images is not None and len(state.queue) > ranks.rank:
        images.prepare(state.queue[-1 - ranks.rank])
    background = step_background(config, state.generator).to(device)
    camera, target = _reduced(capture.camera(view).to(device), target_of(photo, background, masked=capture.masked),
                              divisor_at(config, state.step))
    camera = state.photos.camera(camera, view, extent)
    truth = capture.depth(view, camera.width, camera.height) if config.depth_weight else None
    probes = state.control.probes(scene, number, ranks.count)
    rendering = primitive.draw(scene, camera, background, config, state.step, depth=truth is not None, probes=probes, ranks=ranks)
    loss = photo_loss(state.photos.expose(rendering.image, view), target, config.ssim_weight)
    if truth is not None and rendering.depth is not None:
        loss = loss + config.depth_weight * depth_loss(rendering.depth, rendering.alpha, truth.to(device))
    weights = regulariser_weights(config, state.step, random_start=not capture.has_points)
    regulariser = primitive.regulariser(scene, rendering, extent, weights, ranks)
    loss = loss / ranks.count                             # what is minimised is the sum over ranks
    loss = loss if regulariser is None else loss + regulariser.to(device)
    state.adam.zero_grad()
    state.photos.zero_grad()
    loss.backward()                                       # type: ignore[no-untyped-call]
    for parameter in state.photos.parameters():
        if parameter.grad is not None:
            parameter.grad = ranks.add(parameter.grad)
    seen = rendering.meta.views > 0
    if config.offload:                                    # else the number would be of no use, and worth no wait for the device
        state.drawn = max(state.drawn, int(seen.sum()))
    added = state.control.growth(scene, number)
    quality = psnr(rendering.image.detach(), target)
    with ranks.agreement():
        mine = _finite(loss, quality, [scene, state.photos], f"step {number}, photo {capture.names[view]}")
        check_growth(scene, added, number, device, state.drawn)
    state.control.observe(rendering.meta, camera)
    set_rates(state.adam, primitive.rates(config, extent, state.step, ranks.count), ranks.count)
    adam_step(state.adam, seen)
    primitive.confine(scene)
    state.photos.step(views, config, state.step)
    state.step = number
    losses, qualities = zip(*ranks.numbers(*mine), strict=True)
    state.control.update(scene, state.adam, state.step, ranks.local(state.generator))
    return Step(state.step, capture.names[view], sum(losses), sum(qualities) / ranks.count, scene, state.control.settled(state.step))


def _train(state: FitState, capture: Capture, config: FitConfig, output: Output | None, progress: bool,
           callbacks: Sequence[Callable[[Step], None]]) -> None:
    """All steps that are left."""
    before, begin, kept = state.seconds, time.perf_counter(), state.step          # kept: the step of the last checkpoint; 0: there is none
    with (deferred_interrupt() as interrupt, progress_line(config.steps, state.step, shown=progress) as show,
          PhotoStream(capture.images, one_core=state.device.type == "cpu") as images):
        while state.step < config.steps:
            try:
                step = train_step(state, capture, config, images)
            except (FloatingPointError, MemoryError):
                if output is not None and not kept:
                    save_checkpoint(output.checkpoint, state, config, capture)
                raise
            for callback in callbacks:
                callback(step)
            told = state.ranks.numbers(len(state.gaussians), interrupt.requested)
            sizes, stop = [int(size) for size, _ in told], any(asked for _, asked in told)
            show(step.loss, step.psnr, sum(sizes), state.ranks.count)
            state.history.add(step.number, config.steps, step.loss, step.psnr, sum(sizes))
            if moves(sizes):
                state.rebalance(sizes, capture, config)
            state.seconds = before + time.perf_counter() - begin
            if output is not None and (stop or _due(state, config, kept)):
                save_checkpoint(output.checkpoint, state, config, capture)
                kept = state.step
            if stop:
                raise KeyboardInterrupt(f"stopped after step {state.step} of {config.steps}" + (
                    "" if output is None else f"; the same call goes on from {output.checkpoint}"))


def _due(state: FitState, config: FitConfig, kept: int) -> bool:
    """Whether to write a checkpoint now: if the next settled scene, or the end, will be more than the interval after the last one, `kept`."""
    step, photos = state.step, state.ranks.count
    if step >= config.steps or not state.control.settled(step):
        return False
    following = next((s for s in range(step + photos, config.steps, photos) if state.control.settled(s)), config.steps)
    return following - kept > config.checkpoint_every


def _check_ranks(capture: Capture, config: FitConfig, ranks: Ranks) -> None:
    """What several ranks cannot do, before anything is computed."""
    if ranks.count == 1:
        return
    sizes = sorted(set(zip(capture.width, capture.height, strict=True)))
    if len(sizes) > 1:
        few = ", ".join(f"{width}x{height}" for width, height in sizes[:3]) + (", ..." if len(sizes) > 3 else "")
        raise ValueError(f"data: expected photos of one size with more than one process; got {len(sizes)} sizes: {few}")
    if config.primitive != "gaussians":
        raise NotImplementedError(f"primitive: expected 'gaussians' with more than one process; got {config.primitive!r}")
    if config.offload:
        raise NotImplementedError("offload: expected False with more than one process, of which each has a part of the splats")
    if config.video:
        raise NotImplementedError(f"video: expected 0 with more than one process; got {config.video} (`tsplat render scene.ply --orbit` makes one "
                                  "of the scene)")


def _reduced(camera: Camera, target: Target, divisor: int) -> tuple[Camera, Target]:
    """Both, at 1 / `divisor` of their size."""
    if divisor == 1:
        return camera, target
    width, height = (max(1, round(side / divisor)) for side in (camera.width, camera.height))
    return camera.resized(width, height), target.resized(width, height)


def _finite(loss: Tensor, quality: Tensor, modules: Sequence[nn.Module], where: str) -> tuple[float, float]:
    """Loss and quality as numbers, where the loss and all gradients are finite.

    All that is to be known comes from the device at once: each number alone would be a wait for it (up to 10 in a step).
    """
    gradients = {name: parameter.grad.sum() for module in modules for name, parameter in module.named_parameters() if parameter.grad is not None}
    scalars = [loss.detach(), quality, *gradients.values()]
    numbers: list[float] = torch.stack([scalar.to(loss.device) for scalar in scalars]).tolist()
    if not math.isfinite(numbers[0]):
        raise FloatingPointError(f"{where}: the loss is {numbers[0]}; expected a finite number. The scene is as before this step")
    for name, total in zip(gradients, numbers[2:], strict=True):
        if not math.isfinite(total):
            raise FloatingPointError(f"{where}: the gradient of {name} is not finite. The scene is as before this step")
    return numbers[0], numbers[1]
