"""Quantiles of any number of values, where `torch.quantile` ends at 16 million."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor


def quantiles(values: Tensor, at: Sequence[float]) -> list[float]:
    """Of non-empty `[n]`, the nearest value to each of `at` in 0..1."""
    ordered = values.detach().sort().values
    return [float(ordered[round(q * (len(ordered) - 1))]) for q in at]
