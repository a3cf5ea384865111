"""Memory, asked for before it is needed: a fit that cannot grow says so while it can still be saved."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import NamedTuple

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


def free_bytes(device: torch.device, root: Path = Path("/")) -> int | None:
    """Bytes that can be had on a device, with what torch holds in reserve; None where that is not known.

    In host memory: what the machine has available, or, if that is less, what the limits of the process's control groups (those of a container)
    leave. `root` is where `proc` and `sys` are.
    """
    if device.type == "cuda":
        held = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        return torch.cuda.mem_get_info(device)[0] + held
    available = [int(line.split()[1]) * 1024 for line in _lines(root / "proc" / "meminfo") if line.startswith("MemAvailable:")]
    return min([*available, *_left_in_groups(root)], default=None)


class Groups(NamedTuple):
    """Where a version of Linux's control groups says what. folder: of the groups. files: names of the limit and of the use. pages: of file
    pages in `memory.stat`, which are in use and can be had."""

    folder: str
    files: tuple[str, str]
    pages: tuple[str, str]


GROUPS = {"": Groups("sys/fs/cgroup", ("memory.max", "memory.current"), ("inactive_file", "active_file")),
          "memory": Groups("sys/fs/cgroup/memory", ("memory.limit_in_bytes", "memory.usage_in_bytes"), ("total_inactive_file", "total_active_file"))}
"""By how `/proc/self/cgroup` names the controller: version 2 ("": it has one tree for all), version 1."""


def _left_in_groups(root: Path) -> Iterator[int]:
    """What the limit of the process's group, and of each that holds it, leaves. A container may know its group by a path of the machine, of which
    it sees nothing but the end, as the folder of all groups."""
    for line in _lines(root / "proc" / "self" / "cgroup"):
        _, controllers, path = line.split(":", 2)
        for version in (GROUPS[name] for name in controllers.split(",") if name in GROUPS):
            group = PurePosixPath(path)
            for folder in (root / version.folder / place.relative_to("/") for place in (group, *group.parents)):
                limit, use = ("".join(_lines(folder / name)) for name in version.files)
                if limit.isdigit() and use.isdigit():                        # not "max", nor a group whose files are elsewhere
                    stat = dict(pair.split() for pair in _lines(folder / "memory.stat"))
                    yield max(0, int(limit) - int(use) + sum(int(stat.get(name, 0)) for name in version.pages))


def _lines(path: Path) -> list[str]:
    """Of a file of the kernel; none if it is not there."""
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except OSError:
        return []
