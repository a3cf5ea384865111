"""Memory, asked for before it is needed: a fit that cannot grow says so while it can still be saved."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import nn

COPIES = 6          # of a parameter while splats are added: itself, its gradient, two moments, and the old while the new are made
RENDERING = 600     # bytes per splat of the larger arrays of a step: projections, colours, their gradients, tile lists


def check_growth(scene: nn.Module, added: int, step: int) -> None:
    """See that `added` splats have room.

    Raises:
        MemoryError: with the step, the numbers of splats and of bytes, and what to do.
    """
    device = next(scene.parameters()).device
    free = free_bytes(device) if added else None
    if free is None:
        return
    n = len(next(scene.parameters()))
    needed = bytes_for(scene, n + added) - bytes_for(scene, n) * (COPIES - 2) // COPIES
    if needed > free:
        raise MemoryError(f"step {step}: growing from {n} to {n + added} splats takes about {needed / 2**20:.0f} MiB, and {free / 2**20:.0f} MiB "
                          f"are free on {device}; ask for fewer (max_splats). The scene is as before")


def bytes_for(scene: nn.Module, splats: int) -> int:
    """An estimate of what so many splats like those of `scene` take in a step in which their number changes."""
    each = sum(parameter[:0].element_size() * parameter.shape[1:].numel() for parameter in scene.parameters())
    return splats * (COPIES * each + RENDERING)


def free_bytes(device: torch.device) -> int | None:
    """Bytes that can be had on a device, with what torch holds in reserve; None where that is not known."""
    if device.type == "cuda":
        held = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        return torch.cuda.mem_get_info(device)[0] + held
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")), None)
