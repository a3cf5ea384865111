"""What it costs to keep a scene in host memory (`tsplat fit --offload`): a step with and without, and what it moves.

    python bench/offload.py                          # 100,000 and 1,000,000 splats, on a CPU
    python bench/offload.py --device cuda --splats 1000000 10000000 30000000

Splats of about 1.5 pixels, with SH of degree 3, lie all around 8 cameras that look outward, so that each sees a few percent of them. A step is one
of `tsplat fit`: photo of 320x240, forward, backward, Adam; no densification. Each row gives the splats that were taken, the median times of steps and
of choosing (on a CPU, CPU time, which other work on the machine changes less), and the bytes to the device and back, measured and by formula: per
splat taken 4 bytes for each of 59 parameters and 2 of the probe of density control, both ways, and back also 4 for each of 5 numbers of its
projection. On a CPU there is one memory: what is counted are copies in it. On a GPU each row also gives the peak of its memory, with and without.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from output import add_json, environment, print_json, printing
from torch import Tensor

import tsplat.fit.offload
from tsplat.fit import FitConfig
from tsplat.fit.state import FitState
from tsplat.fit.trainer import train_step
from tsplat.scene import Capture, Gaussians, load_capture, write_synthetic_capture

PARAMETERS, PROBE, PROJECTION = 59, 2, 5
WARM_UP, STEPS = 2, 8


def outward_capture(folder: str) -> Capture:
    """Cameras on a ring that look away from its middle, and photos of something else."""
    capture = load_capture(write_synthetic_capture(folder, views=8, size=(320, 240)), test_every=0)
    capture.viewmats = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])) @ capture.viewmats
    return capture


def scene_around(n: int, focal: float) -> Gaussians:
    """`n` splats of about 1.5 pixels, at distances of 5 to 15 from the origin, in all directions."""
    g = torch.Generator().manual_seed(n)
    distance = 5 + 10 * torch.rand(n, 1, generator=g)
    means = distance * torch.nn.functional.normalize(torch.randn(n, 3, generator=g), dim=1)
    log_scales = (1.5 * distance / focal).log() + 0.3 * torch.randn(n, 3, generator=g)
    return Gaussians(means, torch.randn(n, 4, generator=g), log_scales, torch.randn(n, generator=g) - 1, torch.randn(n, 1, 3, generator=g),
                     0.1 * torch.randn(n, 15, 3, generator=g))


def clock(device: torch.device) -> float:
    """Seconds: of all cores on a CPU, else on the wall."""
    return time.process_time() if device.type == "cpu" else time.perf_counter()


class Traffic:
    """What steps take and send back, and how long they choose."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.taken, self.seconds, self.down, self.up = [0], [0.0], 0, 0

    @contextmanager
    def counted(self) -> Iterator[None]:
        """Within this, all drawing counts."""
        module: Any = tsplat.fit.offload
        may_see, take, spread = module.may_see, module.take, module.spread

        def chosen(*arguments: Any) -> Tensor:
            start = clock(self.device)
            seen = may_see(*arguments)
            self.seconds.append(clock(self.device) - start)
            self.taken.append(int(seen.sum()))
            return seen

        def taken(*arguments: Any) -> Tensor:
            result = take(*arguments)
            self.down += result.nbytes
            return result

        def sent(values: Tensor, *arguments: Any) -> Tensor:
            self.up += values.nbytes
            return spread(values, *arguments)

        module.may_see, module.take, module.spread = chosen, taken, sent
        try:
            yield
        finally:
            module.may_see, module.take, module.spread = may_see, take, spread


def run(n: int, capture: Capture, device: torch.device, optimiser: str, *, offload: bool) -> dict[str, Any]:
    """Medians and means over steps."""
    config = FitConfig(steps=WARM_UP + STEPS, sh_warmup=0.0, density_start=1.0, density_stop=1.0, optimiser=optimiser, offload=offload)
    state = FitState.of(scene_around(n, float(capture.Ks[0, 0, 0])), capture, config, torch.Generator().manual_seed(0), device)
    traffic, times = Traffic(device), []
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    with traffic.counted():
        for _ in range(config.steps):
            start = clock(device)
            train_step(state, capture, config)
            times.append(clock(device) - start)
    result = {"ms": 1e3 * statistics.median(times[WARM_UP:]), "peak_MiB": None}
    if device.type == "cuda":
        result["peak_MiB"] = torch.cuda.max_memory_allocated(device) / 2**20
    if offload:
        total = sum(traffic.taken)
        probed = sum(traffic.taken[:config.steps])                     # the last step has no probe: density control is over
        result.update(
            taken=total / config.steps, choosing_ms=1e3 * statistics.median(traffic.seconds[1 + WARM_UP:]),
            down_MiB=traffic.down / config.steps / 2**20, up_MiB=traffic.up / config.steps / 2**20,
            down_formula_MiB=4 * (PARAMETERS * total + PROBE * probed) / config.steps / 2**20,
            up_formula_MiB=4 * ((PARAMETERS + PROJECTION) * total + PROBE * probed) / config.steps / 2**20)
    return result


def measure_all(sizes: list[int], device: torch.device) -> dict[str, Any]:
    """The table."""
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    print(f"{name}, torch {torch.__version__}, {torch.get_num_threads()} threads\n")
    print("| splats | optimiser | taken | % | ms without | ms with | ms choosing | MiB down | formula | MiB up | formula | peak MiB without | with |")
    print("| --- " * 13 + "|")
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        capture = outward_capture(folder)
        for n in sizes:
            for optimiser in ("adam", "visible"):
                plain, apart = (run(n, capture, device, optimiser, offload=offload) for offload in (False, True))
                peaks = ["" if r["peak_MiB"] is None else f"{r['peak_MiB']:.0f}" for r in (plain, apart)]
                print(f"| {n:,} | {optimiser} | {apart['taken']:,.0f} | {100 * apart['taken'] / n:.1f} | {plain['ms']:.0f} | {apart['ms']:.0f} | "
                      f"{apart['choosing_ms']:.1f} | {apart['down_MiB']:.2f} | {apart['down_formula_MiB']:.2f} | {apart['up_MiB']:.2f} | "
                      f"{apart['up_formula_MiB']:.2f} | {peaks[0]} | {peaks[1]} |", flush=True)
                rows.append({"splats": n, "optimiser": optimiser, "without": plain, "with": apart})
    return {**environment(device.type), "rows": rows}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--splats", type=int, nargs="+", default=[100_000, 1_000_000])
    parser.add_argument("--device", default="cpu")
    add_json(parser)
    args = parser.parse_args()
    with printing(args.json):
        results = measure_all(args.splats, torch.device(args.device))
    if args.json:
        print_json(results)


if __name__ == "__main__":
    main()
