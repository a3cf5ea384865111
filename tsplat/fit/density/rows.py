"""The one way in which splats come, go and move: rows of the parameters are taken, and the optimiser's state with them."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

SHRINK = 1.6      # by which a split divides scales (3DGS, section 5.2)


def take_rows(scene: nn.Module, optimiser: Optimizer, rows: Tensor, fresh: Tensor) -> None:
    """Make `rows` the splats: clone, split, prune and reorder are this with different rows.

    Parameters become new ones of the same names; those of `optimiser` that belong to `scene` are replaced, with state tensors
    that have a row per splat (moments, counts of steps) taken along.

    Args:
        scene: N splats; see `Control`.
        rows: int64 `[M]`, each in 0..N - 1.
        fresh: bool `[M]`, the splats that start without history: their state is zeros.
    """
    owners = {parameter: (group["params"], i) for group in optimiser.param_groups for i, parameter in enumerate(group["params"])}
    for name, old in list(scene.named_parameters()):
        new = nn.Parameter(old.detach()[rows], requires_grad=old.requires_grad)
        setattr(scene, name, new)
        if old in owners:
            params, i = owners[old]
            params[i] = new
            state = optimiser.state.pop(old, None)
            if state is not None:
                optimiser.state[new] = {key: _taken(value, len(old), rows, fresh) for key, value in state.items()}


def forget(scene: nn.Module, optimiser: Optimizer, rows: Tensor | slice, names: tuple[str, ...] | None = None) -> None:
    """Zero the state of splats `rows` (indices or a mask) in the optimiser, of the parameters `names` (default: all)."""
    for name, parameter in scene.named_parameters():
        for value in optimiser.state.get(parameter, {}).values() if names is None or name in names else ():
            if _has_rows(value, len(parameter)):
                value[rows] = 0


def prune(scene: nn.Module, optimiser: Optimizer, keep: Tensor) -> Tensor:
    """Drop all splats but `keep`, bool `[N]`; the rows that stayed, int64."""
    rows = keep.nonzero()[:, 0]
    take_rows(scene, optimiser, rows, torch.zeros_like(rows, dtype=torch.bool))
    return rows


@torch.no_grad()
def grow(scene: nn.Module, optimiser: Optimizer, parents: Tensor, split: Tensor, generator: torch.Generator) -> Tensor:
    """Add a splat for each of `parents`, int64 `[P]`, distinct (3DGS, section 5.2).

    Where `split`, bool `[P]`, a parent is replaced by two of 1/1.6 of its size, at places drawn from it as a density;
    elsewhere it gets a copy, which leaves it by its gradients. New splats (both halves of a split) have no history.

    Returns:
        int64 `[N + P]`, the row that each splat was made from: the N old places first.
    """
    n = len(next(scene.parameters()))
    rows = torch.cat([torch.arange(n, device=parents.device), parents])
    fresh = torch.zeros(len(rows), dtype=torch.bool, device=parents.device)
    fresh[n:] = True
    fresh[parents[split]] = True
    take_rows(scene, optimiser, rows, fresh)
    halves = torch.cat([parents[split], n + split.nonzero()[:, 0]])
    means, log_scales = scene.get_parameter("means"), scene.get_parameter("log_scales")
    local = log_scales[halves].exp() * torch.randn(len(halves), 3, generator=generator).to(means)
    means[halves] += turned(scene.get_parameter("quats")[halves], local)
    log_scales[halves] -= torch.tensor(SHRINK, dtype=means.dtype).log().to(means)
    return rows


def turned(quats: Tensor, vectors: Tensor) -> Tensor:
    """`vectors` `[M, 3]` turned by `quats` `[M, 4]` (wxyz, of any length; those of length 0 do not turn)."""
    quats = torch.nn.functional.normalize(quats, dim=-1)
    w, axis = quats[:, :1], quats[:, 1:]
    twice = 2 * torch.linalg.cross(axis, vectors)
    result: Tensor = vectors + w * twice + torch.linalg.cross(axis, twice)
    return result


def _has_rows(value: object, n: int) -> bool:
    """Whether a value of an optimiser's state has a row per splat: not so a count of steps, which has no dimension."""
    return isinstance(value, Tensor) and value.ndim > 0 and len(value) == n


def _taken(value: object, n: int, rows: Tensor, fresh: Tensor) -> object:
    if not _has_rows(value, n):
        return value
    assert isinstance(value, Tensor)
    taken = value[rows]
    taken[fresh] = 0
    return taken
