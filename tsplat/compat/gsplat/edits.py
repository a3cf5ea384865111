"""Edits of all parameters, their optimisers' moments and running sums at once: what density control does to a scene.

Every edit takes each new row from an old one; they differ in which, and in what they change.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, MutableMapping
from typing import Any

import torch
from torch import Tensor

from tsplat.compat.gsplat.stages import quat_scale_to_covar_preci

Params = MutableMapping[str, torch.nn.Parameter] | torch.nn.ParameterDict
Optimizers = Mapping[str, torch.optim.Optimizer]
State = MutableMapping[str, Any]
FRESH = -1
"""In place of a row: moments that begin at zero."""
SPLIT_SHRINK = 1.6
"""3DGS, section 5.1."""
NOISE_SHARPNESS, NOISE_CENTER = 100.0, 0.995
"""3DGS-MCMC, equation 8: noise for the transparent, 1 / (1 + exp(-k (1 - o - x0)))."""
MAX_COPIES = 51
"""A Gaussian is taken for at most so many in `relocated`."""


@torch.no_grad()
def rebuild(params: Params, optimizers: Optimizers, source: Tensor, moments: Tensor, changed: Mapping[str, Tensor], *,
            only: str | None = None) -> None:
    """New parameters of M rows.

    Args:
        params: `[N, ...]` each. optimizers: one for each that is trained, with one group of one parameter.
        source: int64 `[M]`, the row that each new one is a copy of.
        moments: int64 `[M]`, the row whose moments it gets, or FRESH.
        changed: values `[M, ...]` of parameters that are not copies.
        only: the only parameter to touch.
    """
    for name in [only] if only else list(params.keys()):
        old = params[name]
        value = changed[name] if name in changed else old[source]
        new = torch.nn.Parameter(value.to(old), requires_grad=old.requires_grad)
        params[name] = new
        if name not in optimizers:
            if old.requires_grad:
                raise ValueError(f"optimizers: expected one for {name!r}, which is trained; got {sorted(optimizers)}")
            continue
        optimizer = optimizers[name]
        optimizer.param_groups[0]["params"] = [new]
        kept = optimizer.state.pop(old, None)
        if kept is not None:
            fresh = (moments == FRESH).view(-1, *[1] * (old.ndim - 1))
            optimizer.state[new] = {key: v[moments.clamp_min(0)].masked_fill(fresh, 0.0) if torch.is_tensor(v) and v.shape == old.shape else v
                                    for key, v in kept.items()}


def follow(state: State, source: Tensor, rows: int) -> None:
    """Running sums `[rows]` take the new rows, too."""
    for key, value in state.items():
        if isinstance(value, Tensor) and value.shape[:1] == (rows,):
            state[key] = value[source]


def duplicate(params: Params, optimizers: Optimizers, state: State, mask: Tensor) -> None:
    """A copy of each Gaussian in `mask` `[N]`, at the end."""
    every, chosen = torch.arange(len(mask), device=mask.device), mask.nonzero().squeeze(-1)
    source = torch.cat([every, chosen])
    rebuild(params, optimizers, source, torch.cat([every, torch.full_like(chosen, FRESH)]), {})
    follow(state, source, len(mask))


@torch.no_grad()
def split(params: Params, optimizers: Optimizers, state: State, mask: Tensor, revised_opacity: bool = False) -> None:
    """Two Gaussians drawn from each in `mask` `[N]`, smaller by 1.6, in its place (at the end).

    revised_opacity: 1 - sqrt(1 - o) for both, so that they are as opaque together (Bulo et al. 2024, Revising Densification).
    """
    rest, chosen = (~mask).nonzero().squeeze(-1), mask.nonzero().squeeze(-1)
    source = torch.cat([rest, chosen, chosen])
    scales, new = params["scales"][chosen].exp(), 2 * len(chosen)
    noise = torch.randn(2, len(chosen), 3, device=scales.device, dtype=scales.dtype)
    offsets = _rotate(params["quats"][chosen], scales * noise).reshape(-1, 3)
    changed = {name: params[name][source] for name in ("means", "scales", "opacities")}
    changed["means"][len(rest):] += offsets
    changed["scales"][len(rest):] -= math.log(SPLIT_SHRINK)
    if revised_opacity:
        changed["opacities"][len(rest):] = (1 - (1 - changed["opacities"][len(rest):].sigmoid()).sqrt()).logit()
    rebuild(params, optimizers, source, torch.cat([rest, rest.new_full((new,), FRESH)]), changed)
    follow(state, source, len(mask))


def remove(params: Params, optimizers: Optimizers, state: State, mask: Tensor) -> None:
    """Without the Gaussians in `mask` `[N]`."""
    rest = (~mask).nonzero().squeeze(-1)
    rebuild(params, optimizers, rest, rest, {})
    follow(state, rest, len(mask))


@torch.no_grad()
def reset_opacities(params: Params, optimizers: Optimizers, value: float) -> None:
    """No opacity above `value`, and its moments at zero."""
    opacities = params["opacities"]
    every = torch.arange(len(opacities), device=opacities.device)
    rebuild(params, optimizers, every, torch.full_like(every, FRESH), {"opacities": opacities.clamp_max(math.log(value / (1 - value)))},
            only="opacities")


@torch.no_grad()
def relocate(params: Params, optimizers: Optimizers, mask: Tensor, binoms: Tensor, min_opacity: float) -> None:
    """The dead Gaussians in `mask` `[N]` become copies of living ones, drawn by opacity, that look as before together."""
    dead, alive = mask.nonzero().squeeze(-1), (~mask).nonzero().squeeze(-1)
    if not len(alive):
        return
    chosen = alive[_draw(params["opacities"].flatten()[alive].sigmoid(), len(dead))]
    source = torch.arange(len(mask), device=mask.device)
    moments = source.clone()
    moments[chosen] = FRESH
    source[dead] = chosen
    rebuild(params, optimizers, source, moments, {k: v[source] for k, v in _thinned(params, chosen, binoms, min_opacity).items()})


@torch.no_grad()
def add_copies(params: Params, optimizers: Optimizers, count: int, binoms: Tensor, min_opacity: float) -> None:
    """So many copies of Gaussians, drawn by opacity, that look as before together, at the end."""
    chosen = _draw(params["opacities"].flatten().sigmoid(), count)
    every = torch.arange(len(params["opacities"]), device=chosen.device)
    source = torch.cat([every, chosen])
    rebuild(params, optimizers, source, torch.cat([every, torch.full_like(chosen, FRESH)]),
            {k: v[source] for k, v in _thinned(params, chosen, binoms, min_opacity).items()})


@torch.no_grad()
def add_noise(params: Params, scaler: float) -> None:
    """Noise along the axes of the transparent Gaussians (3DGS-MCMC, equation 8)."""
    covars, _ = quat_scale_to_covar_preci(params["quats"], params["scales"].exp(), compute_preci=False)
    assert covars is not None
    transparent = torch.sigmoid(NOISE_SHARPNESS * (1 - params["opacities"].flatten().sigmoid() - NOISE_CENTER))
    noise = torch.randn_like(params["means"]) * transparent[:, None] * scaler
    params["means"].add_((covars * noise[:, None]).sum(-1))


def binomials() -> Tensor:
    """Float64 `[MAX_COPIES + 1, MAX_COPIES + 1]`: n over k."""
    return torch.tensor([[math.comb(n, k) for k in range(MAX_COPIES + 1)] for n in range(MAX_COPIES + 1)], dtype=torch.float64)


def relocated(opacities: Tensor, scales: Tensor, copies: Tensor, binoms: Tensor) -> tuple[Tensor, Tensor]:
    """Opacities `[n]` and scales `[n, 3]` of each of so many copies `[n]` that look, together, like the one (3DGS-MCMC, equation 9).

    o' = 1 - (1 - o)^(1/n), and scales times o / sum_j=1..n (n over j) (-1)^(j-1) o'^j / sqrt(j): the paper's double sum, of which the inner one
    is a binomial. In float64, as its terms cancel.
    """
    n = copies.clamp(1, MAX_COPIES)
    o = opacities.double()
    new = -torch.expm1(torch.log1p(-o) / n)
    j = torch.arange(1, MAX_COPIES + 1, device=o.device, dtype=o.dtype)
    terms = binoms[n][:, 1:] * (1 - 2 * ((j + 1) % 2)) * new[:, None] ** j / j.sqrt()
    return new.to(opacities), (scales * (o / terms.sum(1))[:, None]).to(scales)


def _thinned(params: Params, chosen: Tensor, binoms: Tensor, min_opacity: float) -> dict[str, Tensor]:
    """Logits and log scales of all, where those `chosen`, of which there will be copies, share their opacity."""
    logits, log_scales = params["opacities"].detach().clone(), params["scales"].detach().clone()
    copies = torch.bincount(chosen, minlength=len(logits))[chosen] + 1
    opacities, scales = relocated(logits.flatten()[chosen].sigmoid(), log_scales[chosen].exp(), copies, binoms)
    opacities = opacities.clamp(min_opacity, 1 - torch.finfo(torch.float32).eps)
    logits[chosen] = opacities.logit().view(-1, *logits.shape[1:])
    log_scales[chosen] = scales.log()
    return {"opacities": logits, "scales": log_scales}


def _draw(weights: Tensor, count: int) -> Tensor:
    """So many indices, with replacement, by weight. (Not torch.multinomial, which takes no more than 2^24 weights.)"""
    sums = weights.double().cumsum(0)
    return torch.searchsorted(sums, torch.rand(count, device=sums.device, dtype=sums.dtype) * sums[-1]).clamp_max(len(sums) - 1)


def _rotate(quats: Tensor, vectors: Tensor) -> Tensor:
    """Vectors `[..., n, 3]` by quaternions `[n, 4]` (wxyz): v + 2 q x (q x v + w v)."""
    unit = torch.nn.functional.normalize(quats, dim=-1).expand(*vectors.shape[:-1], 4)
    w, q = unit[..., :1], unit[..., 1:]
    turned: Tensor = vectors + 2 * torch.linalg.cross(q, torch.linalg.cross(q, vectors) + w * vectors)
    return turned
