"""What all kinds of scenes have in common: parameters with a row for each splat, of which there may be more or fewer tomorrow."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor, nn


class Splats(nn.Module):
    """N splats of some kind: parameters `[N, ...]`, which a kind names in `NAMES` and checks in `check`."""

    opacity_logits: nn.Parameter    # of all kinds

    NAMES: ClassVar[tuple[str, ...]] = ()

    def __init__(self, **tensors: Tensor) -> None:
        super().__init__()
        self.check(tensors)
        for name in self.NAMES:
            self.register_parameter(name, nn.Parameter(tensors[name].detach().clone()))

    def __len__(self) -> int:
        return self.get_parameter(self.NAMES[0]).shape[0]

    @property
    def opacities(self) -> Tensor:
        """`[N]` in 0..1."""
        return self.opacity_logits.sigmoid()

    @property
    def device(self) -> torch.device:
        """Where the parameters are."""
        return self.get_parameter(self.NAMES[0]).device

    @classmethod
    def check(cls, tensors: Mapping[str, Tensor]) -> None:
        """Raise a TypeError or ValueError that names the tensor, unless all are there, of the right shapes, one dtype and device."""
        raise NotImplementedError

    def _load_from_state_dict(self, state_dict: Mapping[str, Any], prefix: str, *args: Any) -> None:
        """Take on the size of the saved tensors first: training changes N."""
        saved = {name: state_dict[prefix + name] for name in self.NAMES if prefix + name in state_dict}
        if len(saved) == len(self.NAMES):
            self.check(saved)
            for name, tensor in saved.items():
                parameter = self.get_parameter(name)
                if parameter.shape != tensor.shape:
                    parameter.data, parameter.grad = parameter.new_empty(tensor.shape), None
        super()._load_from_state_dict(state_dict, prefix, *args)
