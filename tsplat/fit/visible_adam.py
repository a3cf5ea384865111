"""Adam for parameters of which a step sees only some rows: splats in one view, photos one at a time."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer

from tsplat import ops


class VisibleAdam(Optimizer):
    """Adam (Kingma and Ba 2015) in which the rows that a step does not see rest: neither they nor their moments change.

    **Bias.** Adam divides its moments by 1 - beta^t, as they start from 0. A row that has been seen k times has moments of k
    gradients, whatever t is: so each row counts its own steps, and is corrected by 1 - beta^k. It moves as if it were alone with
    a plain Adam that is only called when it is seen. (With the count of all steps, as in a plain Adam, a row that is first seen
    late moves 0.1 / sqrt(0.001) = 3.2 times as far as it should; without any correction, as in Taming 3DGS, every row does.)

    Args:
        params: as of `torch.optim.Adam`; the parameters have a first dimension.
        lr, betas, eps: as there.
    """

    def __init__(self, params: Iterable[Any], lr: float = 1e-3, betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-15) -> None:
        super().__init__(params, {"lr": lr, "betas": betas, "eps": eps})

    @torch.no_grad()
    def step(self, visible: Tensor) -> None:        # type: ignore[override]
        """Move the rows where `visible`, bool `[N]`, of each parameter that has a gradient.

        Raises:
            ValueError: `visible` does not fit a parameter.
        """
        for group in self.param_groups:
            beta1, beta2 = group["betas"]
            for parameter in group["params"]:
                if parameter.grad is None:
                    continue
                if visible.dtype != torch.bool or visible.shape != parameter.shape[:1]:
                    raise ValueError(f"visible: expected bool [{len(parameter)}], for a parameter {list(parameter.shape)}; "
                                     f"got {visible.dtype} {list(visible.shape)}")
                state = self.state[parameter]
                if not state:
                    state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
                    state["steps"] = parameter.new_zeros(len(parameter))
                ops.adam_rows(parameter, parameter.grad, state["exp_avg"], state["exp_avg_sq"], state["steps"], visible,
                              float(group["lr"]), beta1, beta2, group["eps"])
