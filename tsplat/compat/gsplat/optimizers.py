"""gsplat's `SelectiveAdam`."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class SelectiveAdam(torch.optim.Adam):
    """Adam, without its bias correction, of the splats that were visible (Taming 3DGS, Mallick et al. 2024).

    Args:
        params: parameters `[N, ...]` or dicts of groups, one parameter to a group, as for `torch.optim.Adam`.
        eps: added to the denominator.
        betas: decay of the two moments.
    """

    def __init__(self, params: Any, eps: float, betas: tuple[float, float]) -> None:
        super().__init__(params=params, eps=eps, betas=betas)

    @torch.no_grad()
    def step(self, visibility: Tensor) -> None:  # type: ignore[override]
        """Update the rows of each parameter where `visibility` `[N]` is not 0; their moments alone change."""
        rows = visibility.reshape(-1).nonzero().squeeze(-1)
        for group in self.param_groups:
            if len(group["params"]) != 1:
                raise ValueError(f"params: expected one parameter to a group; got {len(group['params'])}")
            param: Tensor = group["params"][0]
            if param.grad is None:
                continue
            if len(param) != visibility.numel():
                raise ValueError(f"visibility: expected {len(param)} numbers, as the parameter has rows; got {visibility.numel()}")
            state = self.state[param]
            if not state:
                state["step"] = torch.tensor(0.0)
                state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(param), torch.zeros_like(param)
            (beta1, beta2), grad = group["betas"], param.grad[rows]
            first = beta1 * state["exp_avg"][rows] + (1 - beta1) * grad
            second = beta2 * state["exp_avg_sq"][rows] + (1 - beta2) * grad * grad
            state["exp_avg"][rows], state["exp_avg_sq"][rows] = first, second
            param.index_add_(0, rows, first / (second.sqrt() + group["eps"]), alpha=-group["lr"])
