"""Memory, asked for before it is needed: a fit that cannot grow says so while it can still be saved."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import nn

COPIES = 6          # of a parameter while splats are added: itself, its gradient, two moments, and the old while the new are made
DRAWN = 2           # of a parameter of a scene that is elsewhere, where it is drawn: itself, its gradient
RENDERING = 600     # bytes per splat of the larger arrays of a step: projections, colours, their gradients, tile lists
ELSEWHERE = 100     # and of those beside the scene if it is drawn elsewhere: opacities, scales, probes, what comes back of the projection


def check_growth(scene: nn.Module, added: int, step: int, device: torch.device, drawn: int) -> None:
    """See that `added` splats have room where the scene is and, if that is not `device`, where a step draws some of them.

    Args:
        scene: as it is.
        added: how many splats more there will be.
        step: for the message.
        device: where the scene is drawn.
        drawn: the most splats of the scene that a step drew: of more splats, it will be as many more.

    Raises:
        MemoryError: with the step, the numbers of splats and of bytes, and what to do.
    """
    if not added:
        return
    home, n = next(scene.parameters()).device, len(next(scene.parameters()))
    rendering = RENDERING if device == home else ELSEWHERE
    needed = {home: bytes_for(scene, n + added, rendering=rendering) - bytes_for(scene, n, rendering=rendering) * (COPIES - 2) // COPIES}
    if device != home:
        needed[device] = bytes_for(scene, -(-drawn * (n + added) // max(1, n)), copies=DRAWN)
    for place, size in needed.items():
        free = free_bytes(place)
        if free is not None and size > free:
            raise MemoryError(f"step {step}: growing from {n} to {n + added} splats takes about {size / 2**20:.0f} MiB, and {free / 2**20:.0f} MiB "
                              f"are free on {place}; ask for fewer (max_splats). The scene is as before")


def bytes_for(scene: nn.Module, splats: int, *, copies: int = COPIES, rendering: int = RENDERING) -> int:
    """An estimate of what so many splats like those of `scene` take in a step, with that many copies of their parameters: by default one in
    which their number changes."""
    each = sum(parameter[:0].element_size() * parameter.shape[1:].numel() for parameter in scene.parameters())
    return splats * (copies * each + rendering)


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
