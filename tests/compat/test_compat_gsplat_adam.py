"""gsplat's SelectiveAdam: Adam of what is visible."""

from __future__ import annotations

import pytest
import torch
from compare import assert_close

from tsplat.compat.gsplat import SelectiveAdam


def test_selective_adam_updates_what_is_visible() -> None:
    """Adam's moments and step without bias correction, in the visible rows; the others stay to the bit."""
    g = torch.Generator().manual_seed(0)
    param = torch.nn.Parameter(torch.randn(6, 2, 3, generator=g, dtype=torch.float64))
    optimizer = SelectiveAdam([{"params": [param], "lr": 0.03}], eps=1e-3, betas=(0.8, 0.9))
    want, m, v = param.detach().clone(), torch.zeros(6, 2, 3), torch.zeros(6, 2, 3)
    for step in range(4):
        visible = torch.rand(6, generator=g) > 0.4
        param.grad = torch.randn(6, 2, 3, generator=g, dtype=torch.float64)
        before = param.detach().clone()
        optimizer.step(visible if step % 2 else visible.float())
        for i in range(6):
            if visible[i]:
                m[i], v[i] = 0.8 * m[i] + 0.2 * param.grad[i], 0.9 * v[i] + 0.1 * param.grad[i] ** 2
                want[i] -= 0.03 * m[i] / (v[i].sqrt() + 1e-3)
        assert torch.equal(param[~visible], before[~visible])
        assert_close(param, want, 1e-7)
    with pytest.raises(ValueError, match="visibility: expected 6"):
        optimizer.step(torch.ones(5))
    with pytest.raises(ValueError, match="one parameter to a group"):
        SelectiveAdam([param, torch.nn.Parameter(torch.ones(6))], eps=1e-8, betas=(0.9, 0.999)).step(torch.ones(6))
