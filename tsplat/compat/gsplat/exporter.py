"""gsplat's `export_splats`."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from tsplat.checks import check_choice, check_tensor
from tsplat.scene.gaussians import SH_C0, Gaussians


def export_splats(means: Tensor, scales: Tensor, quats: Tensor, opacities: Tensor, sh0: Tensor, shN: Tensor, format: str = "ply",
                  save_to: str | None = None) -> bytes:
    """The bytes of a file of Gaussians; those with a number that is not finite are left out.

    Args:
        means: `[N, 3]`. scales: `[N, 3]`, logarithms. quats: `[N, 4]` (wxyz). opacities: `[N]`, logits.
        sh0, shN: `[N, 1, 3]` and `[N, K, 3]`, K = 0, 3, 8, 15 or 24.
        format: "ply", or "splat" (antimatter15's: position, scale, colour, rotation in 32 bytes; without shN).
        save_to: a file to write them to.

    Raises:
        ValueError, TypeError: naming the argument, what came and what is expected.
        NotImplementedError: for "ply_compressed".
    """
    check_choice("format", format, ("ply", "splat", "ply_compressed"))
    if format == "ply_compressed":
        raise NotImplementedError("format: tsplat does not write 'ply_compressed' yet; use 'ply' or 'splat'")
    check_tensor("means", means, ("N", 3))
    n = len(means)
    for name, value, shape in (("scales", scales, (n, 3)), ("quats", quats, (n, 4)), ("opacities", opacities, (n,)), ("sh0", sh0, (n, 1, 3)),
                               ("shN", shN, (n, "K", 3))):
        check_tensor(name, value, shape)
    tensors = [v.detach().cpu().float() for v in (means, quats, scales, opacities, sh0, shN)]
    finite = torch.cat([v.reshape(n, -1) for v in tensors], 1).isfinite().all(1)
    tensors = [v[finite] for v in tensors]
    data = _ply(Gaussians(*tensors)) if format == "ply" else _splat(*tensors[:5])
    if save_to:
        Path(save_to).write_bytes(data)
    return data


def _ply(gaussians: Gaussians) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.ply"
        gaussians.save(path)
        return path.read_bytes()


def _splat(means: Tensor, quats: Tensor, log_scales: Tensor, logits: Tensor, sh0: Tensor) -> bytes:
    """Rows of 6 float32 and 8 bytes, the largest and most opaque first, as viewers of the format load them."""
    order = (log_scales.sum(1).exp() * logits.sigmoid()).argsort(descending=True, stable=True)
    color = torch.cat([sh0[:, 0] * SH_C0 + 0.5, logits.sigmoid()[:, None]], 1) * 255
    rotation = torch.nn.functional.normalize(quats, dim=1) * 128 + 128
    rows = np.zeros(len(means), dtype=[("floats", "<f4", 6), ("bytes", "u1", 8)])
    rows["floats"] = torch.cat([means, log_scales.exp()], 1)[order].numpy()
    rows["bytes"] = torch.cat([color, rotation], 1).clamp(0, 255)[order].to(torch.uint8).numpy()
    return rows.tobytes()
