"""`distributed=True` of the drop-in for gsplat: images, gradients and `meta` against one process."""

from __future__ import annotations

from typing import Any

import scenes
import torch
from compare import assert_close, assert_same_bits, leaves
from gsplat_scenes import loss_of
from ranks import Ranks, expect
from torch import Tensor

from tsplat.compat.gsplat import DefaultStrategy, rasterization

SPLATS = ("means", "quats", "scales", "opacities", "colors")
CAMERAS = ("viewmats", "Ks", "backgrounds")


def whole_scene(ranks: Ranks, degree: int | None = None) -> tuple[dict[str, Tensor], list[int]]:
    """A scene for two cameras per rank, and the numbers of splats of the ranks: 0 of the first."""
    sizes = [14 * (r > 0) + r for r in range(ranks.count)]
    camera = scenes.camera(2 * ranks.count)
    args = dict(zip(SPLATS, scenes.splats(sum(sizes)), strict=True)) | {"viewmats": camera.viewmats, "Ks": camera.Ks}
    if degree is not None:
        args["colors"] = scenes.sh_coefficients(sum(sizes), degree)
    args["backgrounds"] = scenes.uniform(0.0, 1.0, len(camera), 3, seed=scenes.generator(1))
    return args, sizes


def draw(args: dict[str, Tensor], **options: Any) -> tuple[list[Tensor], dict[str, Tensor], Any]:
    """Image and alpha, the arguments as leaves, and `meta`."""
    inputs = dict(zip(args, leaves(*args.values()), strict=True))
    image, alpha, meta = rasterization(**inputs, width=24, height=17, **options)
    meta["means2d"].retain_grad()
    return [image, alpha], inputs, meta


def check_gsplat_images_and_gradients(ranks: Ranks) -> None:
    for packed, options in ((True, {}), (False, {"absgrad": True}), (True, {"absgrad": True, "rasterize_mode": "antialiased", "sh_degree": 2}),
                            (False, {"render_mode": "RGB+ED", "camera_model": "fisheye"}), (True, {"render_mode": "D", "sparse_grad": True})):
        args, sizes = whole_scene(ranks, options.get("sh_degree"))
        args["colors"][4] = torch.inf                                       # left out
        rows = slice(sum(sizes[:ranks.rank]), sum(sizes[:ranks.rank + 1]))
        cams = slice(2 * ranks.rank, 2 * ranks.rank + 2)
        options = {"packed": packed, **options}
        whole, inputs, meta = draw(args, **options)
        part, own_inputs, own_meta = draw({k: v[rows if k in SPLATS else cams] for k, v in args.items()}, distributed=True, **options)
        assert_close(part, [x[cams] for x in whole], 1e-14)
        sum(loss_of(*(x[2 * r:2 * r + 2] for x in whole)) for r in range(ranks.count)).backward()
        loss_of(*part).backward()
        for name, value in own_inputs.items():
            if value.grad is None:                                          # colours and backgrounds of an image of depths
                assert inputs[name].grad is None
                continue
            got, want = (v.grad.to_dense() for v in (value, inputs[name]))
            assert_close(torch.cat([got, want]), torch.cat([want[rows if name in SPLATS else cams], want]), 1e-12)  # relative to the whole

        kept = (meta["gaussian_ids"] >= rows.start) & (meta["gaussian_ids"] < rows.stop) if packed else (slice(None), rows)
        for name in ("radii", "depths", "means2d", "conics", "opacities"):
            assert_close(own_meta[name], meta[name][kept], 1e-14)
        if packed:
            assert_same_bits([own_meta["camera_ids"], own_meta["gaussian_ids"] + rows.start], [meta["camera_ids"][kept], meta["gaussian_ids"][kept]])
        assert_close(own_meta["means2d"].grad, meta["means2d"].grad[kept], 1e-10)
        if options.get("absgrad"):
            assert_close(own_meta["means2d"].absgrad, meta["means2d"].absgrad[kept], 1e-10)
        assert own_meta["n_cameras"] == 2
        expect(NotImplementedError, "meta: tsplat has no lists of tiles", lambda own_meta=own_meta: own_meta["isect_ids"])  # type: ignore[misc]


def check_gsplat_density_control(ranks: Ranks) -> None:
    """`DefaultStrategy` takes up what one process takes up, on the rank of the splats (per own camera, as gsplat does)."""
    args, sizes = whole_scene(ranks)
    rows = slice(sum(sizes[:ranks.rank]), sum(sizes[:ranks.rank + 1]))
    sums = []
    for distributed in (False, True):
        strategy = DefaultStrategy()
        state = strategy.initialize_state()
        given = {k: v[rows if k in SPLATS else slice(2 * ranks.rank, 2 * ranks.rank + 2)] for k, v in args.items()} if distributed else args
        outputs, inputs, meta = draw(given, distributed=distributed)
        strategy.step_pre_backward(inputs, {}, state, 1, meta)
        outputs[0].square().sum().backward()
        strategy.step_post_backward(inputs, {}, state, 1, meta, packed=True)
        sums.append([state["grad2d"] / meta["n_cameras"], state["count"]])
    assert_close(sums[1], [v[rows] for v in sums[0]], 1e-6)                  # in float32


def check_what_gsplat_does_not_distribute(ranks: Ranks) -> None:
    args, _ = whole_scene(ranks)
    per_camera = args | {"colors": args["colors"].expand(len(args["viewmats"]), -1, -1)}
    for wrong in (per_camera, {k: v[None] for k, v in args.items()}):
        expect(ValueError, "distributed: expected no batch dimensions and no colors per camera",
               lambda wrong=wrong: rasterization(**wrong, width=24, height=17, distributed=True))  # type: ignore[misc]
    mode = "RGB" if ranks.rank else "RGB+D"
    expect(ValueError, "render_mode (of RGB, D, ED, RGB+D, RGB+ED): expected the same on all ranks of the group; got 3 on rank 0 and 0 on rank 1",
           lambda: rasterization(**args, width=24, height=17, distributed=True, render_mode=mode))
