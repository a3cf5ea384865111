"""gsplat's density control, as its training loops call it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from tsplat.compat.gsplat.edits import (
    Optimizers,
    Params,
    State,
    add_copies,
    add_noise,
    binomials,
    duplicate,
    relocate,
    remove,
    reset_opacities,
    split,
)

REQUIRED = ("means", "scales", "quats", "opacities")
GROWTH = 1.05


@dataclass
class Strategy:
    """What a training loop calls; the base does nothing."""

    def check_sanity(self, params: Params, optimizers: Optimizers) -> None:
        """Check that each trained parameter has an optimiser of its own, with one group.

        Raises:
            ValueError: otherwise.
        """
        trained = {name for name, p in params.items() if p.requires_grad}
        if trained != set(optimizers.keys()):
            raise ValueError(f"optimizers: expected one for each parameter that is trained, {sorted(trained)}; got {sorted(optimizers)}")
        for name, optimizer in optimizers.items():
            if len(optimizer.param_groups) != 1:
                raise ValueError(f"optimizers: expected one param_group for {name!r}; got {len(optimizer.param_groups)}")

    def step_pre_backward(self, *args: Any, **kwargs: Any) -> None:
        """To call before `loss.backward()`."""

    def step_post_backward(self, *args: Any, **kwargs: Any) -> None:
        """To call after `loss.backward()`."""


@dataclass
class DefaultStrategy(Strategy):
    """Adaptive density control (3DGS, section 5): copy small and split large Gaussians whose image gradient is high, remove transparent ones.

    Args:
        prune_opa: remove below this opacity.
        grow_grad2d: grow above this mean gradient with respect to the 2D mean in units of half the image.
        grow_scale3d: copy up to this scale, relative to the scene, and split above.
        grow_scale2d: split above this radius, relative to the image, until refine_scale2d_stop_iter.
        prune_scale3d, prune_scale2d: remove above, once opacities have been reset.
        refine_start_iter, refine_stop_iter, refine_every: when to.
        reset_every: opacities are reset to at most twice prune_opa every so many steps.
        pause_refine_after_reset: steps after a reset without.
        absgrad: by the absolute gradient (AbsGS): give `absgrad=True` to `rasterization`, too.
        revised_opacity: see `split`.
        verbose: print what was done.
        key_for_gradient: which entry of `info` has the gradient.
    """

    prune_opa: float = 0.005
    grow_grad2d: float = 0.0002
    grow_scale3d: float = 0.01
    grow_scale2d: float = 0.05
    prune_scale3d: float = 0.1
    prune_scale2d: float = 0.15
    refine_scale2d_stop_iter: int = 0
    refine_start_iter: int = 500
    refine_stop_iter: int = 15_000
    reset_every: int = 3000
    refine_every: int = 100
    pause_refine_after_reset: int = 0
    absgrad: bool = False
    revised_opacity: bool = False
    verbose: bool = False
    key_for_gradient: str = "means2d"

    def initialize_state(self, scene_scale: float = 1.0) -> dict[str, Any]:
        """The running sums, made at the first step, and the size of the scene."""
        radii = {"radii": None} if self.refine_scale2d_stop_iter > 0 else {}
        return {"grad2d": None, "count": None, "scene_scale": scene_scale, **radii}

    def check_sanity(self, params: Params, optimizers: Optimizers) -> None:
        """See the base; and that there are means, scales, quats and opacities."""
        super().check_sanity(params, optimizers)
        _check_names(params)

    def step_pre_backward(self, params: Params, optimizers: Optimizers, state: State, step: int, info: Mapping[str, Any]) -> None:
        """Keep the gradient of the 2D means."""
        if self.key_for_gradient not in info:
            raise ValueError(f"info: expected {self.key_for_gradient!r} in it; got {sorted(info)}")
        info[self.key_for_gradient].retain_grad()

    def step_post_backward(self, params: Params, optimizers: Optimizers, state: State, step: int, info: Mapping[str, Any],
                           packed: bool = False) -> None:
        """Take up the gradients, and change the Gaussians if it is time to. packed: as given to `rasterization`."""
        if step >= self.refine_stop_iter:
            return
        self._take_up(params, state, info, packed)
        if step > self.refine_start_iter and step % self.refine_every == 0 and step % self.reset_every >= self.pause_refine_after_reset:
            with torch.no_grad():
                copied, parted = self._grow(params, optimizers, state, step)
                removed = self._prune(params, optimizers, state, step)
            if self.verbose:
                print(f"Step {step}: {copied} copied, {parted} split, {removed} removed: {len(params['means'])} Gaussians.")
            for name in ("grad2d", "count", "radii"):
                if state.get(name) is not None:
                    state[name].zero_()
        if step > 0 and step % self.reset_every == 0:
            reset_opacities(params, optimizers, 2 * self.prune_opa)

    @torch.no_grad()
    def _take_up(self, params: Params, state: State, info: Mapping[str, Any], packed: bool) -> None:
        missing = [key for key in ("width", "height", "n_cameras", "radii", "gaussian_ids", self.key_for_gradient) if key not in info]
        if missing:
            raise ValueError(f"info: expected {missing} in it; got {sorted(info)}")
        if packed != (info["gaussian_ids"] is not None):
            raise ValueError(f"packed: expected {not packed}, as given to rasterization (True by default); got {packed}")
        means2d, radii = info[self.key_for_gradient], info["radii"]
        gradient: Tensor = means2d.absgrad if self.absgrad else means2d.grad
        n, device = len(params["means"]), gradient.device
        for name in ("grad2d", "count", *(("radii",) if self.refine_scale2d_stop_iter > 0 else ())):
            if state[name] is None:
                state[name] = torch.zeros(n, device=device)
        if packed:
            ids = info["gaussian_ids"]
        else:
            visible = (radii > 0).all(-1)                                               # [..., C, N]
            ids, gradient, radii = visible.nonzero()[:, -1], gradient[visible], radii[visible]
        half = torch.tensor([info["width"] / 2, info["height"] / 2], device=device) * info["n_cameras"]
        state["grad2d"].index_add_(0, ids, torch.linalg.vector_norm(gradient * half, dim=-1).float())
        state["count"].index_add_(0, ids, torch.ones(len(ids), device=device))
        if state.get("radii") is not None:
            state["radii"].scatter_reduce_(0, ids, radii.amax(-1) / float(max(info["width"], info["height"])), "amax")

    def _grow(self, params: Params, optimizers: Optimizers, state: State, step: int) -> tuple[int, int]:
        high = state["grad2d"] / state["count"].clamp_min(1) > self.grow_grad2d
        small = params["scales"].exp().amax(-1) <= self.grow_scale3d * state["scene_scale"]
        copied, parted = high & small, high & ~small
        if step < self.refine_scale2d_stop_iter:
            parted = parted | (state["radii"] > self.grow_scale2d)
        if copied.any():
            duplicate(params, optimizers, state, copied)
            parted = torch.cat([parted, parted.new_zeros(int(copied.sum()))])           # no copy is split
        if parted.any():
            split(params, optimizers, state, parted, self.revised_opacity)
        return int(copied.sum()), int(parted.sum())

    def _prune(self, params: Params, optimizers: Optimizers, state: State, step: int) -> int:
        out = params["opacities"].flatten().sigmoid() < self.prune_opa
        if step > self.reset_every:
            out = out | (params["scales"].exp().amax(-1) > self.prune_scale3d * state["scene_scale"])
            if step < self.refine_scale2d_stop_iter:
                out = out | (state["radii"] > self.prune_scale2d)
        if out.any():
            remove(params, optimizers, state, out)
        return int(out.sum())


@dataclass
class MCMCStrategy(Strategy):
    """3DGS as Markov Chain Monte Carlo (Kheradmand et al. 2024): relocate transparent Gaussians, add some, and add noise to the means.

    Args:
        cap_max: no more Gaussians than this.
        noise_lr: noise relative to the learning rate of the means.
        refine_start_iter, refine_stop_iter, refine_every: when to relocate and add.
        min_opacity: transparent below.
        verbose: print what was done.
    """

    cap_max: int = 1_000_000
    noise_lr: float = 5e5
    refine_start_iter: int = 500
    refine_stop_iter: int = 25_000
    refine_every: int = 100
    min_opacity: float = 0.005
    verbose: bool = False

    def initialize_state(self) -> dict[str, Any]:
        """Binomial coefficients."""
        return {"binoms": binomials()}

    def check_sanity(self, params: Params, optimizers: Optimizers) -> None:
        """See the base; and that there are means, scales, quats and opacities."""
        super().check_sanity(params, optimizers)
        _check_names(params)

    def step_post_backward(self, params: Params, optimizers: Optimizers, state: State, step: int, info: Mapping[str, Any], lr: float) -> None:
        """Change the Gaussians if it is time to, and add noise. lr: the learning rate of the means."""
        binoms = state["binoms"] = state["binoms"].to(params["means"].device)
        if self.refine_start_iter < step < self.refine_stop_iter and step % self.refine_every == 0:
            dead = params["opacities"].detach().flatten().sigmoid() <= self.min_opacity
            if dead.any():
                relocate(params, optimizers, dead, binoms, self.min_opacity)
            added = max(0, min(self.cap_max, int(GROWTH * len(params["means"]))) - len(params["means"]))
            if added:
                add_copies(params, optimizers, added, binoms, self.min_opacity)
            if self.verbose:
                print(f"Step {step}: {int(dead.sum())} relocated, {added} added: {len(params['means'])} Gaussians.")
        add_noise(params, lr * self.noise_lr)


def _check_names(params: Params) -> None:
    missing = [name for name in REQUIRED if name not in params]
    if missing:
        raise ValueError(f"params: expected {', '.join(REQUIRED)}; {', '.join(missing)} missing")
