"""The Triton kernel of Adam on some rows, in the interpreter where there is no GPU, against the op's torch."""

from __future__ import annotations

import os

import pytest
import torch
from torch import Tensor

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
if DEVICE.type == "cpu":
    os.environ.setdefault("TRITON_INTERPRET", "1")                              # read when Triton is imported
pytest.importorskip("triton", reason="Triton is not installed here")

from tsplat.kernels.adam import adam_rows  # noqa: E402
from tsplat.ops.adam import adam_rows_op  # noqa: E402


def tensors(n: int, shape: tuple[int, ...], dtype: torch.dtype) -> list[Tensor]:
    """Parameter, gradient, moments, steps and what is visible; where it is not, all but the flag is NaN."""
    g = torch.Generator().manual_seed(n)
    visible = torch.rand(n, generator=g) < 0.6
    rows = [torch.randn(n, *shape, generator=g, dtype=torch.float64) for _ in range(4)]
    rows[3] = rows[3].square()
    steps = torch.randint(0, 2000, (n,), generator=g).double()
    steps[::3] = 0
    for row in (rows[2], rows[3]):
        row[steps == 0] = 0
    for tensor in (*rows, steps):
        tensor[~visible] = torch.nan
    return [*(tensor.to(DEVICE, dtype) for tensor in (*rows, steps)), visible.to(DEVICE)]


def moved(tensors: list[Tensor], kernel: bool, betas: tuple[float, float]) -> list[Tensor]:
    """What is written."""
    mine = [tensor.clone() for tensor in tensors]
    if kernel:
        adam_rows(*mine, 0.1, *betas, 1e-15)
        return [mine[i].cpu() for i in (0, 2, 3, 4)]
    mine = [tensor.cpu() for tensor in mine]
    adam_rows_op(*mine, 0.1, *betas, 1e-15)
    return [mine[i] for i in (0, 2, 3, 4)]


@pytest.mark.parametrize("shape", [(), (1,), (3,), (4,), (15, 3), (24, 3)])
@pytest.mark.parametrize("n", [0, 1, 700])
@pytest.mark.parametrize("betas", [(0.9, 0.999), (0.0, 0.5)])
def test_rows_are_moved_as_by_torch(shape: tuple[int, ...], n: int, betas: tuple[float, float]) -> None:
    args = tensors(n, shape, torch.float64)
    # one_minus_exp leaves out terms of 2e-10 at the worst
    torch.testing.assert_close(moved(args, True, betas), moved(args, False, betas), atol=1e-9, rtol=1e-9, equal_nan=True)


def test_float32_is_as_good_as_float32_can_be() -> None:
    args = tensors(700, (3,), torch.float32)
    exact = moved([a.double() if a.is_floating_point() else a for a in args], False, (0.9, 0.999))
    got = moved(args, True, (0.9, 0.999))
    # 1 - exp just above the series' end: 6e-8 / 0.1, of a step of at most 0.1 sqrt(1000), which is added to numbers of about 1
    torch.testing.assert_close([x.double() for x in got], exact, atol=3e-6, rtol=1e-6, equal_nan=True)


def test_what_is_written_has_to_be_contiguous() -> None:
    args = tensors(4, (3,), torch.float64)
    args[2] = args[2].T.contiguous().T
    with pytest.raises(ValueError, match="^exp_avg: expected a contiguous tensor"):
        adam_rows(*args, 0.1, 0.9, 0.999, 1e-15)
