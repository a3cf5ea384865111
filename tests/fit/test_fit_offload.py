"""A fit of which the scene stays in host memory has the same bits as one without, and takes to its device what is seen alone."""

import dataclasses
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from compare import assert_same_bits, saved_state
from torch import Tensor

import tsplat.fit.offload
from tsplat import Camera
from tsplat.fit import FitConfig, Step, draw, fit
from tsplat.fit.memory import bytes_for
from tsplat.fit.offload import draw_rows
from tsplat.scene import Capture, Gaussians, load_capture, read_image, write_image

Make = Callable[..., FitConfig]
TURN = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))


@pytest.fixture
def outward(capture: Capture) -> Capture:
    """As `capture`, with points on a sphere around it, and every other camera turned to look at these alone."""
    assert capture.points is not None
    assert capture.point_colors is not None
    g = torch.Generator().manual_seed(0)
    around = 6 * torch.nn.functional.normalize(torch.randn(403, 3, generator=g), dim=1)
    capture.points, capture.point_colors = torch.cat([capture.points, around]), torch.cat([capture.point_colors, torch.rand(403, 3, generator=g)])
    capture.viewmats[1::2] = TURN @ capture.viewmats[1::2]
    return capture


@pytest.fixture
def shares(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The parts of all splats that were taken, draw by draw."""
    found = []
    may_see = tsplat.fit.offload.may_see

    def noted(means: Tensor, *others: Any) -> Tensor:
        seen = may_see(means, *others)
        found.append(int(seen.sum()) / len(means))
        return seen

    monkeypatch.setattr(tsplat.fit.offload, "may_see", noted)
    return found


def everything(gaussians: Gaussians, camera: Camera, probe: str, *, offload: bool, **options: Any) -> list[Tensor]:
    """All that a drawing gives, and the gradients of all it is made of."""
    camera = dataclasses.replace(camera, viewmats=camera.viewmats.clone().requires_grad_())
    probes = {probe: torch.zeros(1, len(gaussians), 2, requires_grad=True)}

    def drawn(rows: Any, probes: dict[str, Tensor]) -> Any:
        return draw(rows, camera, torch.ones(3), probes=probes, **options)

    r = draw_rows(drawn, gaussians, camera, probes) if offload else drawn(gaussians, probes=probes)
    g = torch.Generator().manual_seed(0)
    loss = (r.image * torch.randn(r.image.shape, generator=g)).sum() + (r.alpha * torch.randn(r.alpha.shape, generator=g)).sum()
    loss = loss + (gaussians.opacities * r.meta.depths).where(r.meta.visible, 0.0).sum() + (0 if r.depth is None else r.depth.mean())
    inputs = [*gaussians.parameters(), probes[probe], camera.viewmats]
    results = torch.autograd.grad(loss, inputs, materialize_grads=True)
    return [r.image, r.alpha, r.meta.radii, r.meta.means2d, r.meta.depths, *results]


@pytest.mark.parametrize(("n", "degree", "options"), [
    (1, 3, {}), (7, 2, {"antialiased": True}), (203, 3, {}), (203, 2, {"sh_degree": 1}), (1000, 2, {"depth": "accumulated"}), (4999, 2, {}),
    (5000, 4, {"sh_degree": 0}), (33_001, 1, {})])
@pytest.mark.parametrize("probe", ["screen_offset", "absgrad"])
def test_a_drawing_and_its_gradients(n: int, degree: int, options: dict[str, Any], probe: str, shares: list[float]) -> None:
    """To the last bit, with any number of splats: as many as fill whole vectors and blocks of the CPU's, or not."""
    g = torch.Generator().manual_seed(n)
    scene = Gaussians.random(n, -4.0, 4.0, degree, generator=g)
    with torch.no_grad():
        scene.quats.copy_(torch.randn(n, 4, generator=g))
        scene.log_scales.add_(torch.randn(n, 3, generator=g)).clamp_(max=-1.5)
        scene.opacity_logits.copy_(3 * torch.randn(n, generator=g))
        scene.sh_rest.copy_(0.3 * torch.randn(scene.sh_rest.shape, generator=g))
    camera = Camera.look_at((0.2, -0.3, 0.1), (1, 0.5, 4), width=40, height=30)
    whole = everything(scene, camera, probe, offload=False, **options)
    assert_same_bits(everything(scene, camera, probe, offload=True, **options), whole)
    assert len(shares) == 1
    assert shares[0] < 0.4


@pytest.mark.parametrize("changes", [
    {"optimiser": "visible"},
    {"antialiased": True, "resolution_warmup": 0.6, "opacity_depth_reg": 0.01, "background": "random", "sh_warmup": 0.8},
    {"density": "adaptive", "density_threshold": 1e-5, "reset_every": 9000},
    {"density": "adaptive", "density_threshold": 1e-5, "density_absgrad": True, "optimiser": "visible", "opacity_reg": 0.1, "scale_reg": 0.1},
    {"density": "mcmc"}, {"density": "mcmc", "optimiser": "visible", "sh_warmup": 0.8},
    {"density": "none", "refine_poses": True, "pose_steps": 2}, {"density": "none", "exposure": True, "optimiser": "visible", "sh_degree": 0}],
    ids=lambda changes: ", ".join(f"{name}={value}" for name, value in changes.items()))
def test_a_fit(outward: Capture, config: Make, tmp_path: Path, shares: list[float], changes: dict[str, Any]) -> None:
    c = config(steps=15, density_start=0.1, density_stop=0.9, density_every=4, **{"max_splats": 800, "video": 2, **changes})
    whole = fit(outward, c, tmp_path / "whole", progress=False)
    assert not shares
    apart = fit(outward, dataclasses.replace(c, offload=True), tmp_path / "apart", progress=False)
    assert saved_state(tmp_path / "apart") == saved_state(tmp_path / "whole")
    for name in ("scene.ply", "turntable.gif", "contact.png"):
        assert (tmp_path / "apart" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    assert (apart.qualities, apart.refined) == (whole.qualities, whole.refined)
    assert len(shares) >= 15 + 2 + 2                                   # steps, held-out photos, frames of the video
    assert sorted(shares[:15])[5] < 0.2                                # a third of the steps at least are of cameras that look outward


def test_a_fit_to_photos_with_masks_and_depths(outward: Capture, capture_folder: Path, config: Make, tmp_path: Path) -> None:
    for name in ("images", "masks", "depths"):
        (tmp_path / name).mkdir()
    mask = torch.ones(24, 32, 1)
    mask[:, 20:] = 0
    for name in outward.names:
        write_image(tmp_path / "images" / name, read_image(capture_folder / "images" / name) / 255)
        write_image(tmp_path / "masks" / name, mask)
        np.save(tmp_path / "depths" / f"{Path(name).stem}.npy", 3 + torch.rand(24, 32).numpy())
    (tmp_path / "sparse").symlink_to(capture_folder / "sparse")
    masked = load_capture(tmp_path, test_every=4)
    assert masked.masked
    masked.points, masked.point_colors, masked.viewmats = outward.points, outward.point_colors, outward.viewmats
    for offload in (False, True):
        fit(masked, config(steps=10, depth_weight=0.1, offload=offload), tmp_path / str(offload), progress=False)
    assert saved_state(tmp_path / "True") == saved_state(tmp_path / "False")


@pytest.mark.parametrize("first", [False, True])
def test_a_fit_goes_on_with_or_without(outward: Capture, config: Make, tmp_path: Path, first: bool) -> None:
    def press(step: Step) -> None:
        if step.number == 7:
            os.kill(os.getpid(), signal.SIGINT)

    c = config(steps=15, density_start=0.1, density_stop=0.9, density_every=4, max_splats=800)
    with pytest.raises(KeyboardInterrupt):
        fit(outward, dataclasses.replace(c, offload=first), tmp_path / "stopped", progress=False, callbacks=[press])
    steps: list[Step] = []
    fit(outward, dataclasses.replace(c, offload=not first), tmp_path / "stopped", progress=False, callbacks=[steps.append])
    assert steps[0].number == 8
    fit(outward, c, tmp_path / "whole", progress=False)
    assert saved_state(tmp_path / "stopped") == saved_state(tmp_path / "whole")


def test_spheres_are_refused() -> None:
    with pytest.raises(NotImplementedError, match=r"^offload: only scenes of Gaussians .* got primitive = 'spheres'$"):
        FitConfig(offload=True, primitive="spheres")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU: whether a scene fits in its memory")
def test_a_gpu_holds_a_part_of_the_scene(outward: Capture, config: Make) -> None:
    """Of 200,000 splats each camera sees few; the images are too small to count. The scores are close; not more, as Adam runs elsewhere."""
    outward.viewmats[::2] = TURN @ outward.viewmats[::2]
    scores, peaks = [], []
    for offload in (False, True):
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        result = fit(outward, config(splats=200_000, offload=offload), progress=False, device="cuda")
        peaks.append(torch.cuda.max_memory_allocated() - before)
        assert result.mean is not None
        scores.append(result.mean.psnr)
        assert result.gaussians.device.type == ("cpu" if offload else "cuda")
        scene = bytes_for(result.gaussians, 200_000, copies=1, rendering=0)
        del result
    assert peaks[1] < scene < peaks[0]
    assert scores[1] == pytest.approx(scores[0], abs=0.1)
