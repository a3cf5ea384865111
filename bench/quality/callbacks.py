"""Callbacks of the quality scripts: the curve of the score over time, how many splats a second, and which stage takes what part of a step."""

from __future__ import annotations

import contextlib
import functools
import re
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from typing import Any
from unittest import mock

import torch
from torch.autograd import DeviceType
from torch.profiler import ProfilerActivity, profile, record_function

import tsplat.ops
from tsplat.fit import FitConfig, Step
from tsplat.fit.evaluation import evaluate, mean_quality
from tsplat.scene import Capture

PROFILED = 20        # steps
STAGES = {"projection": "project|_FullyFusedProjection", "harmonics": "harmonics|_SphericalHarmonics", "outlines": "outlines", "binning": "binning",
          "blending": "blend(_spheres)?|_RasterizeToPixels", "SSIM": "aten::convolution", "Adam": r"Optimizer\.step.*"}
"""By the names of their events: those of our ops and of gsplat's autograd functions; "binning", which has no gradient, is marked by `marked`."""


class Curve:
    """Scores the scene after some parts of the steps, or as soon as it has settled then; and counts splats.

    Attributes:
        points: seconds since the start, without those of scoring, and mean PSNR of the held-out photos in dB.
        wall, cpu: seconds that scoring took.
        drawn: sum of the number of splats over steps.
    """

    def __init__(self, capture: Capture, config: FitConfig, parts: Sequence[float], device: torch.device) -> None:
        self.capture, self.config, self.device = capture, config, device
        self.due = sorted(round(part * config.steps) for part in parts)
        self.wall, self.cpu, self.start, self.drawn = 0.0, 0.0, time.perf_counter(), 0
        self.points: list[tuple[float, float]] = []

    def __call__(self, step: Step) -> None:
        """After each step."""
        self.drawn += len(step.gaussians)
        if not self.due or step.number < self.due[0] or not step.settled:
            return
        self.due = [number for number in self.due if number > step.number]
        wait(self.device)
        wall, cpu = time.perf_counter(), time.process_time()
        mean = mean_quality(evaluate(step.gaussians, self.capture, self.capture.test, self.config, device=self.device))
        assert mean is not None
        self.points.append((wall - self.start - self.wall, mean.psnr))
        self.wall += time.perf_counter() - wall
        self.cpu += time.process_time() - cpu


class Shares:
    """Profiles some of the last steps: what part of their time on the device the stages take, which are custom ops."""

    def __init__(self, config: FitConfig, device: torch.device) -> None:
        self.begin, self.end, self.device = max(1, config.steps - PROFILED - 1), config.steps - 1, device
        gpu = [ProfilerActivity.CUDA] if device.type == "cuda" else []
        self.profiler = profile(activities=[ProfilerActivity.CPU, *gpu])
        self.marks = contextlib.ExitStack()
        self.text = ""

    def __call__(self, step: Step) -> None:
        """After each step."""
        if step.number == self.begin < self.end:
            wait(self.device)
            self.marks.enter_context(marked())
            self.profiler.start()
        elif step.number == self.end > self.begin:
            wait(self.device)
            self.profiler.stop()
            self.marks.close()
            total, shares = stage_times(self.profiler.key_averages(), gpu=self.device.type == "cuda")
            where = "on the GPU " if self.device.type == "cuda" else ""
            self.text = f"of {1e-3 * total / (self.end - self.begin):.3g} ms {where}a step: " + ", ".join(
                f"{name} {100 * us / total:.0f} %" for name, us in sorted(shares.items(), key=lambda item: -item[1]) if us > total / 100)


def stage_times(events: Iterable[Any], *, gpu: bool) -> tuple[float, dict[str, float]]:
    """Microseconds of all steps and of each stage, forward and backward, from averages of a profile.

    On a CPU, CPU time. On a GPU, time of kernels: all that ran there, and for a stage those that were started within its event on the CPU.
    """
    events = list(events)
    here = [event for event in events if event.device_type == DeviceType.CPU]
    if gpu:
        # of kernels alone: events on the CPU have the time of theirs, too, and marks ("user annotations") span kernels
        total = sum(event.self_device_time_total for event in events if event.device_type != DeviceType.CPU and not event.is_user_annotation)
    else:
        total = sum(event.self_cpu_time_total for event in here)
    taken = "device_time_total" if gpu else "cpu_time_total"
    return total, {f"{stage}{way}": sum(getattr(event, taken) for event in here if re.fullmatch(f"({name}){suffix}", event.key))
                   for stage, name in STAGES.items() for way, suffix in (("", ""), (", backward", "_?[Bb]ackward"))}


@contextlib.contextmanager
def marked() -> Iterator[None]:
    """Within this, what finds the tiles of splats, ours or gsplat's, is an event "binning" of a profile."""
    with contextlib.ExitStack() as stack:
        for module, name in ((tsplat.ops, "bin_splats"), (sys.modules.get("gsplat.rendering"), "isect_tiles")):
            if (function := getattr(module, name, None)) is not None:
                stack.enter_context(mock.patch.object(module, name, functools.partial(_marked, function)))
        yield


def _marked(function: Any, *arguments: Any, **options: Any) -> Any:
    with record_function("binning"):
        return function(*arguments, **options)


def wait(device: torch.device) -> None:
    """For what was started on a GPU, before a clock is read."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
