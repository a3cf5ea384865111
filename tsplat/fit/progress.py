"""The progress line of a fit."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

SMOOTHING = 0.95      # photos differ: loss and PSNR are running means


@contextmanager
def progress_line(steps: int, done: int, *, shown: bool) -> Iterator[Callable[[float, float, int, int], None]]:
    """Give a function of loss, PSNR in dB and number of splats that counts a step, or several, and shows them."""
    from tqdm import tqdm

    means: tuple[float, float] | None = None

    def show(loss: float, psnr: float, splats: int, count: int) -> None:
        nonlocal means
        old = means or (loss, psnr)
        means = (old[0] + (1 - SMOOTHING) * (loss - old[0]), old[1] + (1 - SMOOTHING) * (psnr - old[1]))
        bar.set_postfix_str(f"loss {means[0]:.4f}, PSNR {means[1]:.2f} dB, {splats} splats", refresh=False)
        bar.update(min(count, steps - bar.n))

    with tqdm(total=steps, initial=done, unit="step", disable=not shown, dynamic_ncols=True) as bar:
        yield show
