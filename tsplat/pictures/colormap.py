"""Numbers as colours."""

from __future__ import annotations

from torch import Tensor

VIRIDIS = (
    (0.274, 0.006, 0.333), (0.108, 1.396, 1.387), (-0.327, 0.215, 0.092), (-4.600, -5.758, -19.292), (6.204, 14.154, 56.656),
    (4.752, -13.749, -65.321), (-5.432, 4.642, 26.272),
)
"""Red, green and blue of 1, x, ..., x^6: our least-squares fit to the 256 colours of viridis (S. van der Walt and N. Smith 2015, CC0, from
matplotlib), off by 4.4/255 at most. It is perceptually uniform and rises in lightness, so that it survives grey printing."""


def viridis(values: Tensor) -> Tensor:
    """Colours `[..., 3]` in 0..1 of values `[...]`, clamped to 0..1: dark violet, blue, green, yellow. NaN is as 0."""
    x = values.nan_to_num(0.0, 1.0, 0.0).clamp(0, 1)[..., None]
    colors = values.new_zeros(())
    for coefficients in reversed(VIRIDIS):
        colors = colors * x + values.new_tensor(coefficients)
    return colors.clamp(0, 1)
