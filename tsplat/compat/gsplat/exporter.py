"""gsplat's `export_splats` on tsplat's file formats."""

from __future__ import annotations

import tempfile
from pathlib import Path

import torch
from torch import Tensor

from tsplat.checks import check_choice, check_tensor
from tsplat.scene import Gaussians

SUFFIXES = {"ply": ".ply", "splat": ".splat", "ply_compressed": ".compressed.ply"}


def export_splats(means: Tensor, scales: Tensor, quats: Tensor, opacities: Tensor, sh0: Tensor, shN: Tensor, format: str = "ply",
                  save_to: str | None = None) -> bytes:
    """The bytes of a file of Gaussians, in their order; those with a number that is not finite are left out.

    Args:
        means: `[N, 3]`. scales: `[N, 3]`, logarithms. quats: `[N, 4]` (wxyz). opacities: `[N]`, logits.
        sh0, shN: `[N, 1, 3]` and `[N, K, 3]`, K = 0, 3, 8, 15 or 24.
        format: "ply", "splat" (antimatter15's; without shN) or "ply_compressed" (PlayCanvas's).
        save_to: a file to write them to.

    Raises:
        ValueError, TypeError: naming the argument, what came and what is expected.
    """
    check_choice("format", format, tuple(SUFFIXES))
    check_tensor("means", means, ("N", 3))
    n = len(means)
    for name, value, shape in (("scales", scales, (n, 3)), ("quats", quats, (n, 4)), ("opacities", opacities, (n,)), ("sh0", sh0, (n, 1, 3)),
                               ("shN", shN, (n, "K", 3))):
        check_tensor(name, value, shape)
    shN = shN[:, :0] if format == "splat" else shN
    tensors = [v.detach().cpu().float() for v in (means, quats, scales, opacities, sh0, shN)]
    finite = torch.cat([v.reshape(n, -1) for v in tensors], 1).isfinite().all(1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"scene{SUFFIXES[format]}"
        Gaussians(*(v[finite] for v in tensors)).save(path)
        data = path.read_bytes()
    if save_to:
        Path(save_to).write_bytes(data)
    return data
