"""`FitConfig`: what decides how a scene is fitted. The command line's options are made from it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any, Literal, get_args

from tsplat.checks import check_choice
from tsplat.scene.gaussians import MAX_SH_DEGREE

Background = Literal["black", "white", "random"]


def _about(text: str, low: float = -math.inf, high: float = math.inf, *, decides: bool = True) -> dict[str, Any]:
    """Metadata of a field: its help text, its range, and whether it can change the result."""
    return {"help": text, "low": low, "high": high, "decides": decides}


@dataclass(frozen=True)
class FitConfig:
    """How to fit. What each field means is the `help` of its metadata, which `tsplat fit --help` prints.

    Learning rates are those of 3DGS (section 7.1 and its code), which are made for 30,000 steps; `learning_rates` adapts
    them to `steps`. What falls or rises over a fit (the rate of the means, the degree of the colours) does so over its whole
    length. So few steps are a short fit, not the beginning of a long one.

    Raises:
        ValueError, TypeError: naming the field, what came and what is expected.
    """

    steps: int = field(default=1000, metadata=_about("optimisation steps, one photo each", 0))
    downscale: float = field(default=1.0, metadata=_about("divide the size of the photos by this", 1))
    test_every: int = field(default=8, metadata=_about(
        "hold out every n-th photo, in the order of their names, for the evaluation; 0: none", 0))
    splats: int = field(default=30_000, metadata=_about(
        "splats to start with at least; where there are fewer points, more are put around them", 0))
    sh_degree: int = field(default=3, metadata=_about("degree of the spherical harmonics of the colours", 0, MAX_SH_DEGREE))
    sh_warmup: float = field(default=0.1, metadata=_about("part of the steps in which the degree rises to that", 0, 1))
    init_opacity: float = field(default=0.1, metadata=_about("opacity of the first splats", 1e-6, 1 - 1e-6))
    init_scale: float = field(default=1.0, metadata=_about("size of the first splats, in distances to their neighbours", 1e-6))
    antialiased: bool = field(default=False, metadata=_about("compensate the opacity of splats smaller than a pixel"))
    background: Background = field(default="black", metadata=_about(
        "what lies behind the splats and behind photos with alpha; random: new at each step, white in the evaluation"))
    ssim_weight: float = field(default=0.2, metadata=_about("loss = (1 - w) L1 + w (1 - SSIM)", 0, 1))
    lr_means: float = field(default=1.6e-4, metadata=_about("first learning rate of the means, per extent of the scene", 0))
    lr_means_decay: float = field(default=0.01, metadata=_about(
        "last over first learning rate of the means; log-linear in between", 1e-9, 1))
    lr_scales: float = field(default=5e-3, metadata=_about("learning rate of the log scales", 0))
    lr_quats: float = field(default=1e-3, metadata=_about("learning rate of the quaternions", 0))
    lr_opacities: float = field(default=5e-2, metadata=_about("learning rate of the opacity logits", 0))
    lr_sh0: float = field(default=2.5e-3, metadata=_about("learning rate of the constant colour coefficients", 0))
    lr_sh_rest: float = field(default=1.25e-4, metadata=_about("learning rate of the other colour coefficients", 0))
    seed: int = field(default=0, metadata=_about("of all that is random", 0, 2**62))
    checkpoint_every: int = field(default=500, metadata=_about("steps between checkpoints", 1, decides=False))

    def __post_init__(self) -> None:
        for item in fields(self):
            _check(item.name, str(item.type), getattr(self, item.name), item.metadata["low"], item.metadata["high"])


def _check(name: str, kind: str, value: object, low: float, high: float) -> None:
    """Check `value` against the annotation `kind` of its field and its range."""
    if kind == "Background":
        check_choice(name, value, get_args(Background))
    elif kind == "bool" or isinstance(value, bool):
        if not (kind == "bool" and isinstance(value, bool)):
            raise TypeError(f"{name}: expected {kind}; got {value!r}")
    elif not isinstance(value, int if kind == "int" else int | float):
        raise TypeError(f"{name}: expected {kind}; got {value!r}")
    elif not low <= value <= high or math.isinf(value):
        expected = f"{low:g} to {high:g}" if high < math.inf else f"a finite number of at least {low:g}"
        raise ValueError(f"{name}: expected {expected}; got {value!r}")
