"""`fit`: from posed photos to Gaussians (3DGS, sections 5.1 and 7.1, without density control)."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from tsplat.fit.checkpoint import restore, save_checkpoint
from tsplat.fit.config import FitConfig
from tsplat.fit.drawing import draw, step_background
from tsplat.fit.evaluation import Quality, evaluate, mean_quality
from tsplat.fit.initial import initial_gaussians
from tsplat.fit.interrupt import deferred_interrupt
from tsplat.fit.losses import photo_loss, psnr, target_of
from tsplat.fit.optimiser import learning_rates, make_adam, set_rates, sh_degree_at
from tsplat.fit.output import Output
from tsplat.fit.progress import progress_line
from tsplat.fit.state import FitState
from tsplat.scene import Capture, Gaussians, load_capture


@dataclass(frozen=True)
class Step:
    """What a callback is told after each step.

    Args:
        number: steps done.
        photo: its name.
        loss, psnr: of its render before the step (PSNR in dB).
        gaussians: the scene after the step. A callback may look at it, not change it.
    """

    number: int
    photo: str
    loss: float
    psnr: float
    gaussians: Gaussians


@dataclass(frozen=True)
class FitResult:
    """What a fit gives.

    Args:
        gaussians: the scene.
        qualities: PSNR and SSIM of the held-out photos, by name.
        seconds: wall time of the steps, also of those before an interruption.
    """

    gaussians: Gaussians
    qualities: dict[str, Quality]
    seconds: float

    @property
    def mean(self) -> Quality | None:
        """Mean quality, or None if no photo was held out."""
        return mean_quality(self.qualities)


def fit(data: Capture | str | os.PathLike[str], config: FitConfig | None = None, out: str | os.PathLike[str] | None = None, *,
        resume: bool = True, progress: bool = True, callbacks: Sequence[Callable[[Step], None]] = (),
        device: str | torch.device = "cpu") -> FitResult:
    """Fit a scene to photos: one photo per step, at random without replacement, Adam on L1 and SSIM.

    Args:
        data: a capture, or the folder of one (see `load_capture`; `downscale` and `test_every` of the config apply to a
            folder only).
        config: default `FitConfig()`.
        out: a folder, made if need be, for `scene.ply`, `metrics.json`, `test/<photo>.png` (held-out photo beside
            render) and `checkpoint.pt`. Other files in it are left alone. None: nothing is written.
        resume: go on from the checkpoint in `out`, if there is one. A fit that was interrupted and resumed ends, on the same
            machine, with the same bits as one that was not.
        progress: show a line with loss, PSNR and number of splats.
        callbacks: each is called after each step.
        device: where to compute.

    Raises:
        ValueError, FileNotFoundError: bad data, no photo to train on, a checkpoint of another fit.
        FileExistsError: `out` holds a file of one of these names that is not from a fit.
        FloatingPointError: a loss or gradient that is not finite, naming the step and the photo. The last checkpoint stays.
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
    output = None if out is None else Output(Path(out))
    saved = None if output is None else output.open()
    if output is not None and saved is not None and resume:
        state = restore(output.checkpoint, saved, config, capture, device)
    else:
        state = start(capture, config, device)
    _train(state, capture, config, output, progress, callbacks)
    if output is not None:
        save_checkpoint(output.checkpoint, state, config, capture)
        output.pictures.mkdir(exist_ok=True)
    qualities = evaluate(state.gaussians, capture, capture.test, config, None if output is None else output.pictures)
    if output is not None:
        output.write(state.gaussians, config, qualities, state.seconds)
    return FitResult(state.gaussians, qualities, state.seconds)


def start(capture: Capture, config: FitConfig, device: torch.device) -> FitState:
    """The state before the first step."""
    generator = torch.Generator().manual_seed(config.seed)
    gaussians = initial_gaussians(capture, config, generator).to(device)
    return FitState(gaussians, make_adam(gaussians), generator)


def train_step(state: FitState, capture: Capture, config: FitConfig) -> Step:
    """Render one photo's view, compare, and move the parameters. Nothing changes if it raises FloatingPointError."""
    gaussians = state.gaussians
    device = gaussians.means.device
    view = state.next_view(capture.train)
    background = step_background(config, state.generator).to(device)
    target = target_of(capture.images[view].to(device), background, masked=capture.masked)
    rendering = draw(gaussians, capture.camera(view).to(device), background, sh_degree=sh_degree_at(config, state.step),
                     antialiased=config.antialiased)
    loss = photo_loss(rendering.image, target, config.ssim_weight)
    state.adam.zero_grad()
    loss.backward()                                       # type: ignore[no-untyped-call]
    _check_finite(float(loss.detach()), gaussians, f"step {state.step + 1}, photo {capture.names[view]}")
    set_rates(state.adam, learning_rates(config, capture.extent, state.step))
    state.adam.step()
    state.step += 1
    return Step(state.step, capture.names[view], float(loss.detach()), float(psnr(rendering.image.detach(), target)), gaussians)


def _train(state: FitState, capture: Capture, config: FitConfig, output: Output | None, progress: bool,
           callbacks: Sequence[Callable[[Step], None]]) -> None:
    """All steps that are left."""
    before, begin = state.seconds, time.perf_counter()
    with deferred_interrupt() as interrupt, progress_line(config.steps, state.step, shown=progress) as show:
        while state.step < config.steps:
            step = train_step(state, capture, config)
            show(step.loss, step.psnr, len(state.gaussians))
            for callback in callbacks:
                callback(step)
            state.seconds = before + time.perf_counter() - begin
            due = state.step % config.checkpoint_every == 0 and state.step < config.steps
            if output is not None and (due or interrupt.requested):
                save_checkpoint(output.checkpoint, state, config, capture)
            if interrupt.requested:
                raise KeyboardInterrupt(f"stopped after step {state.step} of {config.steps}" + (
                    "" if output is None else f"; the same call goes on from {output.checkpoint}"))


def _check_finite(loss: float, gaussians: Gaussians, where: str) -> None:
    if not math.isfinite(loss):
        raise FloatingPointError(f"{where}: the loss is {loss}; expected a finite number. The scene is as before this step")
    for name, parameter in gaussians.named_parameters():
        if parameter.grad is not None and not bool(parameter.grad.sum().isfinite()):
            raise FloatingPointError(f"{where}: the gradient of {name} is not finite. The scene is as before this step")
