"""What the trainer has to know of what a scene is made of. A new kind of scene is one more class here, and no branch elsewhere."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, Protocol, TypeAlias

from torch import Tensor

from tsplat.camera import Camera
from tsplat.fit.config import FitConfig
from tsplat.fit.density import MCMC, AdaptiveControl, Budget, Control, NoControl
from tsplat.fit.drawing import draw
from tsplat.fit.initial import initial_gaussians
from tsplat.fit.losses import scene_regulariser
from tsplat.fit.offload import draw_rows
from tsplat.fit.optimiser import learning_rates
from tsplat.fit.ranks import ALONE, Ranks
from tsplat.fit.schedules import density_schedule, reset_interval, sh_degree_at
from tsplat.fit.sphere_primitive import SphereDrawing, SpherePrimitive
from tsplat.rasterize import Rendering
from tsplat.scene import Capture, Gaussians

Scene: TypeAlias = Any              # what a primitive makes: `Splats` with `save` (`Gaussians`, `Spheres`)
Drawing: TypeAlias = Rendering | SphereDrawing
MAX_SPLATS = 1_000_000              # where a kind of density control without a budget ends


class Primitive(Protocol):
    """How scenes of one kind are started, drawn and optimised. The arguments are those of the classes that do it."""

    def start(self, capture: Capture, config: FitConfig, generator: Any) -> Scene:
        """The scene before the first step."""
        ...

    def load(self, saved: dict[str, Tensor]) -> Scene:
        """The scene of which `state_dict` was saved."""
        ...

    def draw(self, scene: Scene, camera: Camera, background: Tensor, config: FitConfig, step: int | None = None, *, depth: bool = False,
             probes: Mapping[str, Tensor] | None = None, ranks: Ranks = ALONE) -> Drawing:
        """Render as at `step`, or (None) as finished, on the device of camera and background; the splats of all ranks in the own camera."""
        ...

    def regulariser(self, scene: Scene, rendering: Any, extent: float, weights: Mapping[str, float], ranks: Ranks = ALONE) -> Tensor | None:
        """What the loss has besides the photo; the sum over ranks counts."""
        ...

    def rates(self, config: FitConfig, extent: float, step: int, photos: int = 1) -> dict[str, float]:
        """The learning rate of each parameter, by name, for steps of so many photos."""
        ...

    def confine(self, scene: Scene) -> None:
        """Bring back what a step has moved out of its range."""
        ...

    def control(self, config: FitConfig, extent: float, splats: int, ranks: Ranks = ALONE) -> Control:
        """Density control of a scene that starts with that many splats, on all ranks."""
        ...


class GaussianPrimitive:
    """3D Gaussians."""

    def start(self, capture: Capture, config: FitConfig, generator: Any) -> Scene:
        """See `initial_gaussians`."""
        return initial_gaussians(capture, config, generator)

    def load(self, saved: dict[str, Tensor]) -> Scene:
        """From its parameters."""
        return Gaussians(**saved)

    def draw(self, scene: Scene, camera: Camera, background: Tensor, config: FitConfig, step: int | None = None, *, depth: bool = False,
             probes: Mapping[str, Tensor] | None = None, ranks: Ranks = ALONE) -> Rendering:
        """With the bands of colours that are in use at `step`."""
        drawn = partial(draw, camera=camera, background=background, sh_degree=None if step is None else sh_degree_at(config, step),
                        antialiased=config.antialiased, depth="accumulated" if depth else None, group=ranks.group)
        return draw_rows(drawn, scene, camera, probes or {}) if config.offload else drawn(scene, probes=probes)

    def regulariser(self, scene: Scene, rendering: Rendering, extent: float, weights: Mapping[str, float], ranks: Ranks = ALONE) -> Tensor | None:
        """See `scene_regulariser`."""
        return scene_regulariser(scene.opacities, scene.scales, rendering.meta, extent, **weights, ranks=ranks)

    def rates(self, config: FitConfig, extent: float, step: int, photos: int = 1) -> dict[str, float]:
        """See `learning_rates`."""
        return learning_rates(config, extent, step, photos)

    def confine(self, scene: Scene) -> None:
        """All parameters are unbounded."""

    def control(self, config: FitConfig, extent: float, splats: int, ranks: Ranks = ALONE) -> Control:
        """The kind that the config names."""
        schedule, most = density_schedule(config, ranks.count), config.max_splats or MAX_SPLATS
        if config.density == "budget":
            return Budget(extent, schedule, config.max_splats or splats, ranks=ranks)
        if config.density == "mcmc":
            return MCMC(schedule, most, ranks=ranks)
        if config.density == "adaptive":
            return AdaptiveControl(extent, schedule, threshold=config.density_threshold, absgrad=config.density_absgrad,
                                   reset_every=reset_interval(config), max_splats=most, ranks=ranks)
        return NoControl()


def primitive_of(config: FitConfig) -> Primitive:
    """The primitive that the config names."""
    return SpherePrimitive() if config.primitive == "spheres" else GaussianPrimitive()
