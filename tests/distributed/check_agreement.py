"""What ranks must agree on: errors on all of them, and no process that waits for ever."""

from __future__ import annotations

import dataclasses
from typing import Any

import scenes
import torch
from ranks import Ranks, expect
from shards import compare, shards_of
from torch import Tensor

from tsplat import Camera, rasterize


def check_differences_between_ranks_are_errors_on_all(ranks: Ranks) -> None:
    """Nobody waits for ever, and the group works afterwards."""
    last = ranks.count - 1
    odd = ranks.rank == last
    base = {k: v[:10] for k, v in scenes.splats(10)._asdict().items()}
    camera = scenes.camera(2, 24, 17)

    def differ(text: str, camera: Camera = camera, arguments: dict[str, Tensor] = base, **options: Any) -> None:
        expect(ValueError, text.replace("LAST", f"rank {last}"), lambda: rasterize(camera=camera, **arguments, group=ranks.group, **options))

    end = "expected the same on all ranks of the group; got"
    differ(f"number of cameras: {end} 2 on rank 0 and 1 on LAST", camera[:1] if odd else camera)
    differ(f"number of cameras: {end} 2 on rank 0 and 1 on LAST", camera[0] if odd else camera)
    differ(f"camera.width: {end} 24 on rank 0 and 25 on LAST", scenes.camera(2, 25, 17) if odd else camera)
    differ(f"camera.height: {end} 17 on rank 0 and 18 on LAST", scenes.camera(2, 24, 18) if odd else camera)
    differ(f"camera.model (of pinhole, orthographic, fisheye): {end} 0 on rank 0 and 2 on LAST",
           dataclasses.replace(camera, model="fisheye") if odd else camera)
    differ(f"camera.near: {end} 0.01 on rank 0 and 1 on LAST", dataclasses.replace(camera, near=1.0) if odd else camera)
    differ(f"camera.far: {end} 10000000000 on rank 0 and 9 on LAST", dataclasses.replace(camera, far=9.0) if odd else camera)
    differ(f"antialiased: {end} 0 on rank 0 and 1 on LAST", antialiased=odd)
    differ(f"eps2d: {end} 0.3 on rank 0 and 0.1 on LAST", eps2d=0.1 if odd else 0.3)
    differ(f"channels of colors: {end} 3 on rank 0 and 2 on LAST", arguments=base | {"colors": base["colors"][:, :2 if odd else 3]})
    differ(f"sh_degree (-1: None): {end} -1 on rank 0 and 1 on LAST", arguments=base | ({"colors": scenes.sh_coefficients(10, 1)} if odd else {}),
           sh_degree=1 if odd else None)
    differ(f"absgrad (1: given): {end} 0 on rank 0 and 1 on LAST",
           absgrad=torch.zeros(2 * ranks.count, 10, 2, dtype=torch.float64) if odd else None)
    differ(f"requires_grad of the splats (1: yes, 0: no or no_grad): {end} 0 on rank 0 and 1 on LAST",
           arguments=base | {"means": base["means"].clone().requires_grad_(odd)})
    differ(f"requires_grad of the cameras (1: yes, 0: no or no_grad): {end} 0 on rank 0 and 1 on LAST",
           dataclasses.replace(camera, viewmats=camera.viewmats.clone().requires_grad_(odd)))
    single = torch.float32 if odd else torch.float64
    differ(f"dtype (bits of a number): {end} 64 on rank 0 and 32 on LAST", camera.to(single), {k: v.to(single) for k, v in base.items()})
    with torch.set_grad_enabled(not odd):
        differ(f"requires_grad of the splats (1: yes, 0: no or no_grad): {end} 1 on rank 0 and 0 on LAST",
               arguments=base | {"means": base["means"].clone().requires_grad_()})
    compare(ranks, shards_of(ranks, 2))


def check_what_is_wrong_on_each_rank(ranks: Ranks) -> None:
    """Before anything is sent."""
    arguments, camera = scenes.splats(4)._asdict(), scenes.camera(2)
    expect(NotImplementedError, "capacity: expected None with a group", lambda: rasterize(camera=camera, **arguments, group=ranks.group, capacity=9))
    for name in ("screen_offset", "absgrad"):
        probe = {name: torch.zeros(2, 4, 2, dtype=torch.float64)}
        expect(ValueError, f"{name}: expected shape [{2 * ranks.count}, 4, 2]; got [2, 4, 2]",
               lambda probe=probe: rasterize(camera=camera, **arguments, group=ranks.group, **probe))  # type: ignore[misc]
