"""`FitConfig`: what decides how a scene is fitted. The command line's options are made from it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any, Literal, get_args

import torch

from tsplat.checks import check_choice
from tsplat.scene.gaussians import MAX_SH_DEGREE

Background = Literal["black", "white", "random"]
Density = Literal["budget", "adaptive", "mcmc", "none"]
Primitive = Literal["gaussians", "spheres"]
Optimiser = Literal["adam", "visible"]
BASICS, PHOTOS, START, DENSITY, LOSS, CAMERAS, SPHERES, RATES, OUTPUT = (
    "basics", "photos", "start and course", "density control", "loss", "exposure and poses", "spheres", "optimiser", "output")
CHOICES = {"Background": Background, "Density": Density, "Primitive": Primitive, "Optimiser": Optimiser}


def _about(topic: str, text: str, low: float = -math.inf, high: float = math.inf, *, decides: bool = True) -> dict[str, Any]:
    """Metadata of a field: under which heading its help is, that text, its range, and whether it can change the result."""
    return {"topic": topic, "help": text, "low": low, "high": high, "decides": decides}


@dataclass(frozen=True)
class FitConfig:
    """How to fit. What each field means is the `help` of its metadata, which `tsplat fit --help` prints.

    Learning rates are those of 3DGS (section 7.1 and its code), which are made for 30,000 steps; `learning_rates` adapts
    them to `steps`. What falls or rises over a fit (the rate of the means, the degree of the colours) does so over its whole
    length. So few steps are a short fit, not the beginning of a long one.

    Raises:
        ValueError, TypeError: naming the field, what came and what is expected.
        NotImplementedError: `offload` of spheres.
    """

    primitive: Primitive = field(default="gaussians", metadata=_about(BASICS, "what the scene is made of"))
    steps: int = field(default=1000, metadata=_about(BASICS, "optimisation steps, one photo each", 0))
    downscale: float = field(default=1.0, metadata=_about(PHOTOS, "divide the size of the photos by this", 1))
    test_every: int = field(default=8, metadata=_about(PHOTOS,
        "hold out every n-th photo, in the order of their names, for the evaluation; 0: none", 0))
    splats: int = field(default=30_000, metadata=_about(BASICS,
        "splats to start with at least; where there are fewer points, more are put around them", 0))
    max_splats: int = field(default=0, metadata=_about(BASICS,
        "never more splats than this; 0: with the density control `budget` as many as it starts with, with others 1,000,000", 0))
    density: Density = field(default="budget", metadata=_about(DENSITY,
        "density control; budget: exactly max_splats in the end, by score; adaptive: clone, split, prune and reset as in 3DGS; "
        "mcmc: relocation and noise; none"))
    density_start: float = field(default=1 / 60, metadata=_about(DENSITY, "part of the steps before density control", 0, 1))
    density_stop: float | None = field(default=None, metadata=_about(DENSITY,
        "part of the steps after which it ends; default 1/2, with mcmc 5/6", 0, 1))
    density_every: int = field(default=100, metadata=_about(DENSITY, "steps between its actions; a twentieth of the steps at most", 1))
    density_absgrad: bool = field(default=False, metadata=_about(DENSITY,
        "adaptive: judge by gradients without regard to sign (budget always does)"))
    density_threshold: float | None = field(default=None, metadata=_about(DENSITY,
        "adaptive: screen-space gradient (NDC) from which splats are cloned or split; default 2e-4, and 8e-4 with absgrad", 0))
    reset_every: int = field(default=3000, metadata=_about(DENSITY,
        "adaptive: steps between resets of the opacities in a fit of 30,000, in proportion in others; 0: never", 0))
    sh_degree: int = field(default=3, metadata=_about(START, "degree of the spherical harmonics of the colours", 0, MAX_SH_DEGREE))
    sh_warmup: float = field(default=0.1, metadata=_about(START, "part of the steps in which the degree rises to that", 0, 1))
    resolution_warmup: float = field(default=0.0, metadata=_about(START,
        "part of the steps in which photos are at 1/4 and then, as long, at 1/2 of their size", 0, 1))
    init_opacity: float | None = field(default=None, metadata=_about(START,
        "opacity of the first splats; default 0.1, with mcmc and for spheres 0.5", 1e-6, 1 - 1e-6))
    init_scale: float | None = field(default=None, metadata=_about(START,
        "size of the first splats, in distances to their neighbours; default 1, with mcmc 0.1", 1e-6))
    antialiased: bool = field(default=False, metadata=_about(BASICS, "compensate the opacity of splats smaller than a pixel"))
    background: Background = field(default="black", metadata=_about(BASICS,
        "what lies behind the splats and behind photos with alpha; random: new at each step, white in the evaluation"))
    ssim_weight: float = field(default=0.2, metadata=_about(LOSS, "loss = (1 - w) L1 + w (1 - SSIM)", 0, 1))
    opacity_reg: float | None = field(default=None, metadata=_about(LOSS,
        "weight of the mean opacity in the loss, until density control ends, and for half the steps at most; default 0.01 with mcmc, and with budget "
        "where there are no points to start from, else 0", 0))
    scale_reg: float | None = field(default=None, metadata=_about(LOSS,
        "weight of the mean scale in the loss, until density control ends, and for half the steps at most; default 0, with mcmc 0.01", 0))
    opacity_depth_reg: float = field(default=0.0, metadata=_about(LOSS,
        "weight of minus the mean of opacity times depth over extent: opaque splats in front of the cameras give way (Pulsar)", 0))
    depth_weight: float = field(default=0.0, metadata=_about(LOSS, "weight of the relative error of depth, where photos have depth maps", 0))
    exposure: bool = field(default=False, metadata=_about(CAMERAS, "fit an affine change of colours to each photo"))
    lr_exposure: float = field(default=1e-3, metadata=_about(CAMERAS, "learning rate of these", 0))
    refine_poses: bool = field(default=False, metadata=_about(CAMERAS,
        "fit the poses of the cameras, too; those of held-out photos afterwards, to the finished scene, for a second score"))
    lr_poses: float = field(default=1e-4, metadata=_about(CAMERAS, "first learning rate of poses: radians, and shifts per extent of the scene", 0))
    pose_steps: int = field(default=50, metadata=_about(CAMERAS, "steps in which the pose of each held-out photo is refined", 0))
    gamma_first: float = field(default=0.1, metadata=_about(SPHERES, "spheres: gamma at the first step, soft", 1e-5, 1))
    gamma_last: float = field(default=1e-2, metadata=_about(SPHERES, "spheres: gamma at the last step, hard; log-linear in between", 1e-5, 1))
    fade_below: float = field(default=1.0, metadata=_about(SPHERES,
        "spheres: their positions and radii move less if their radius is below this many pixels, where gradients are noise", 0))
    optimiser: Optimiser = field(default="adam", metadata=_about(RATES,
        "visible: splats that a step does not see rest in it, and keep moments and bias correction of their own"))
    lr_means: float = field(default=1.6e-4, metadata=_about(RATES, "first learning rate of the means, per extent of the scene", 0))
    lr_means_decay: float = field(default=0.01, metadata=_about(RATES,
        "last over first learning rate of the means; log-linear in between", 1e-9, 1))
    lr_scales: float = field(default=5e-3, metadata=_about(RATES, "learning rate of the log scales", 0))
    lr_quats: float = field(default=1e-3, metadata=_about(RATES, "learning rate of the quaternions", 0))
    lr_opacities: float = field(default=5e-2, metadata=_about(RATES, "learning rate of the opacity logits", 0))
    lr_sh0: float = field(default=2.5e-3, metadata=_about(RATES, "learning rate of the constant colour coefficients", 0))
    lr_sh_rest: float = field(default=1.25e-4, metadata=_about(RATES, "learning rate of the other colour coefficients", 0))
    seed: int = field(default=0, metadata=_about(BASICS, "of all that is random", 0, 2**62))
    offload: bool = field(default=False, metadata=_about(BASICS,
        "keep the scene in host memory; a step takes to the device what its camera may see (Gaussians only; the same result)", decides=False))
    video: int = field(default=0, metadata=_about(OUTPUT, "frames of a turntable, OUT/turntable.gif; 0: none", 0, decides=False))
    checkpoint_every: int = field(default=500, metadata=_about(OUTPUT,
        "steps between checkpoints; right after a reset of the opacities there is none", 1, decides=False))

    def __post_init__(self) -> None:
        for item in fields(self):
            _check(item.name, str(item.type), getattr(self, item.name), item.metadata["low"], item.metadata["high"])
        if self.density_start > (stop := self.value("density_stop")):
            raise ValueError(f"density_start: expected at most density_stop = {stop:g}; got {self.density_start!r}")
        if self.offload and self.primitive != "gaussians":
            raise NotImplementedError(f"offload: only scenes of Gaussians can stay in host memory yet; got primitive = {self.primitive!r}")

    def home(self, device: torch.device) -> torch.device:
        """Where the scene of a fit that computes on `device` is kept."""
        return torch.device("cpu") if self.offload else device

    def value(self, name: str, *, random_start: bool = False) -> float:
        """Of a field of which the default, None, stands for what suits the kind of fit (`DEFAULTS`).

        Args:
            name: of the field.
            random_start: whether the capture has no points to start from.
        """
        given, defaults = getattr(self, name), DEFAULTS[name]
        kind = "spheres" if self.primitive == "spheres" else "random budget" if random_start and self.density == "budget" else self.density
        return float(defaults.get(kind, defaults["others"]) if given is None else given)


DEFAULTS = {
    "density_stop": {"mcmc": 5 / 6, "others": 0.5},
    "init_opacity": {"mcmc": 0.5, "spheres": 0.5, "others": 0.1},
    "init_scale": {"mcmc": 0.1, "others": 1.0},
    "opacity_reg": {"random budget": 0.01, "mcmc": 0.01, "others": 0.0},
    "scale_reg": {"mcmc": 0.01, "others": 0.0},
}
"""Of 3DGS (others), and of 3DGS-MCMC (Kheradmand et al. 2024, section 4; its code relocates up to step 25,000 of 30,000).

With a budget, the weight of the opacity makes splats fade that no photo needs, of which random points leave many in front of the cameras and behind
surfaces: 34.4 dB in place of 30.0 for massa, and 34.1 in place of 16.7 for chair (at 100x100, 750 steps). Kept up to the end it gave 34.1 and 33.6,
and with mcmc 33.3 in place of 35.2. So it ends at half the steps also with mcmc, which then goes on to 5/6, as its authors do: 33.5 dB; without
weights or control after half the steps 33.1, with both up to 5/6 31.7 (massa at 128x128, 750 steps, 8,000 splats, means of two). Fox, which starts
from points, has no such splats: 30.6 dB in place of 31.0 (means of four)."""


def _check(name: str, kind: str, value: object, low: float, high: float) -> None:
    """Check `value` against the annotation `kind` of its field and its range."""
    if kind.endswith(" | None"):
        if value is None:
            return
        kind = kind.removesuffix(" | None")
    if kind in CHOICES:
        check_choice(name, value, get_args(CHOICES[kind]))
    elif kind == "bool" or isinstance(value, bool):
        if not (kind == "bool" and isinstance(value, bool)):
            raise TypeError(f"{name}: expected {kind}; got {value!r}")
    elif not isinstance(value, int if kind == "int" else int | float):
        raise TypeError(f"{name}: expected {kind}; got {value!r}")
    elif not low <= value <= high or math.isinf(value):
        expected = f"{low:g} to {high:g}" if high < math.inf else f"a finite number of at least {low:g}"
        raise ValueError(f"{name}: expected {expected}; got {value!r}")
