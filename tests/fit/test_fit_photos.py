"""Poses and exposures of photos, photos read ahead, and memory asked for beforehand."""

import json
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import tsplat.fit.memory
from tsplat import Camera
from tsplat.fit import FitConfig, Step, draw, fit
from tsplat.fit.evaluation import evaluate, mean_quality
from tsplat.fit.memory import bytes_for, check_growth, free_bytes
from tsplat.fit.photos import PhotoParameters
from tsplat.fit.pose import moved, refined
from tsplat.fit.stream import PhotoStream
from tsplat.fit.trainer import start, train_step
from tsplat.rasterize import rasterize
from tsplat.scene import Capture, Gaussians, load_capture, write_synthetic_capture
from tsplat.scene.synthetic import synthetic_cameras, synthetic_scene

Make = Callable[..., FitConfig]


def test_increment_is_a_shift_and_a_rotation_in_the_cameras_axes() -> None:
    camera = Camera.look_at((0, 0, -4), (0, 0, 0), width=8, height=8)
    assert torch.equal(moved(camera, torch.zeros(6), 2.0).viewmats, camera.viewmats)
    shifted = moved(camera, torch.tensor([0.5, 0, 0, 0, 0, 0]), 2.0)
    torch.testing.assert_close(shifted.viewmats[:3, 3] - camera.viewmats[:3, 3], torch.tensor([1.0, 0, 0]))
    turned = moved(camera, torch.tensor([0, 0, 0, 0, 0, 2.0]), 2.0)                        # 2 tan(90 degrees / 2)
    torch.testing.assert_close(turned.viewmats[:3, :3] @ torch.eye(3)[0], torch.tensor([0.0, 1, 0]), atol=1e-6, rtol=0)


def test_increment_has_a_gradient_at_zero() -> None:
    camera = Camera.look_at((1, 2, -4), (0, 0, 0), width=8, height=8, dtype=torch.float64)
    zero = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: moved(camera, x, 2.0).viewmats, zero)


def test_refined_pose_comes_back() -> None:
    truth = Camera.look_at((0, 0, -4), (0, 0, 0), width=8, height=8)
    wrong = moved(truth, torch.tensor([0.02, -0.01, 0.0, 0.0, 0.02, -0.01]), 1.0)

    def loss(camera: Camera) -> torch.Tensor:
        return (camera.viewmats - truth.viewmats).square().sum()

    found = refined(wrong, loss, 1.0, 100, 3e-3)
    assert not found.viewmats.requires_grad
    assert float(loss(found)) < 0.01 * float(loss(wrong))
    assert float(loss(refined(wrong, loss, 1.0, 3, 1e3))) <= float(loss(wrong))      # the best on the way, if all steps are bad
    assert torch.equal(refined(wrong, loss, 1.0, 0, 1.0).viewmats, wrong.viewmats)


def test_exposure_changes_one_photo_and_leaves_the_mean(config: Make) -> None:
    photos = PhotoParameters(3, config(exposure=True))
    image = torch.rand(4, 5, 3, generator=torch.Generator().manual_seed(0))
    assert torch.equal(photos.expose(image, 1), image)
    photos.expose(image, 1).sum().backward()
    photos.step([1], config(exposure=True), 0)
    assert photos.exposures is not None
    assert (photos.exposures[1] != 0).all()
    assert (photos.exposures[[0, 2]] == 0).all()
    exposed = torch.stack([photos.expose(image, i) for i in range(3)])
    torch.testing.assert_close(exposed.mean(0).detach(), image)
    assert not torch.equal(exposed[1], image)


def test_photos_of_different_exposure(capture: Capture, config: Make) -> None:
    """Half the photos at 60 % of the light: held-out ones, as bright as the mean, are met better where exposure is fitted."""
    images = [capture.images[i] for i in range(len(capture))]
    level = [0.6 if i % 2 else 1.0 for i in range(len(capture))]
    mean = sum(level[i] for i in capture.train) / len(capture.train)
    capture.images = [image * (mean if i in capture.test else level[i]) for i, image in enumerate(images)]      # type: ignore[assignment]
    plain, fitted = (fit(capture, config(steps=60, density="none", exposure=e, lr_exposure=1e-2), progress=False).mean for e in (False, True))
    assert plain is not None
    assert fitted is not None
    assert fitted.psnr > plain.psnr + 0.2


def test_poses_that_are_off(capture: Capture, config: Make, tmp_path: Path) -> None:
    generator = torch.Generator().manual_seed(0)
    for i in range(len(capture)):
        increment = 0.02 * torch.randn(6, generator=generator)
        capture.viewmats[i] = moved(capture.camera(i), increment, 1.0).viewmats
    c = config(steps=40, density="none", refine_poses=True, lr_poses=1e-3, pose_steps=20)
    result = fit(capture, c, tmp_path, progress=False)
    assert result.mean is not None
    assert result.refined_mean is not None
    assert result.refined_mean.psnr > result.mean.psnr + 0.5
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["mean_with_refined_poses"]["psnr"] == result.refined_mean.psnr
    assert metrics["mean"]["psnr"] == result.mean.psnr
    plain = fit(capture, config(steps=2), progress=False)
    assert plain.refined_mean is None


def test_training_poses_come_back(tmp_path: Path, config: Make) -> None:
    """Cameras to train on are off, held-out ones are right: these score better where the others are refined, which come nearer to where they were."""
    capture = load_capture(write_synthetic_capture(tmp_path, views=12, size=(64, 48)), test_every=4)
    true, generator = capture.viewmats.clone(), torch.Generator().manual_seed(0)
    for i in capture.train:
        capture.viewmats[i] = moved(capture.camera(i), 0.03 * torch.randn(6, generator=generator), 1.0).viewmats
    scores, errors = [], []
    for refine in (False, True):
        c = config(steps=100, splats=1000, max_splats=1000, density="none", refine_poses=refine, lr_poses=1e-3)
        state = start(capture, c, torch.device("cpu"))
        for _ in range(c.steps):
            train_step(state, capture, c)
        mean = mean_quality(evaluate(state.gaussians, capture, capture.test, c))
        assert mean is not None
        scores.append(mean.psnr)
        with torch.no_grad():
            cameras = [state.photos.camera(capture.camera(i), i, capture.extent) for i in capture.train]
        errors.append(sum(float((camera.viewmats - true[i]).norm()) for camera, i in zip(cameras, capture.train, strict=True)))
    assert errors[1] < 0.7 * errors[0]
    assert scores[1] > scores[0] + 0.5


def test_scene_does_not_change_while_held_out_poses_are_refined(capture: Capture, config: Make, tmp_path: Path) -> None:
    steps: list[Step] = []
    result = fit(capture, config(steps=3, refine_poses=True, pose_steps=3), tmp_path, progress=False, callbacks=[steps.append])
    assert steps[-1].gaussians is result.gaussians
    again = fit(capture, config(steps=3, refine_poses=True, pose_steps=0), progress=False)
    for mine, other in zip(result.gaussians.parameters(), again.gaussians.parameters(), strict=True):
        assert torch.equal(mine, other)


def test_depth_maps(capture_folder: Path, config: Make, tmp_path: Path) -> None:
    for name in ("images", "sparse"):
        (tmp_path / name).symlink_to(capture_folder / name)
    (tmp_path / "depths").mkdir()
    np.save(tmp_path / "depths" / "view_001.npy", np.full((48, 64), 3.0))
    np.save(tmp_path / "depths" / "view_002.png.npy", np.arange(6).reshape(2, 3))
    capture = load_capture(tmp_path, test_every=4)
    assert capture.depth(0, 32, 24) is None
    assert torch.equal(capture.depth(1, 32, 24), torch.full((24, 32), 3.0))      # type: ignore[arg-type]
    assert capture.depth(2, 6, 2).tolist() == [[0, 0, 1, 1, 2, 2], [3, 3, 4, 4, 5, 5]]      # type: ignore[union-attr]
    np.save(tmp_path / "depths" / "view_002.png.npy", np.zeros(3))
    with pytest.raises(ValueError, match=r"view_002\.png\.npy: expected depths \[h, w\]; got float64 \[3\]"):
        capture.depth(2, 6, 2)
    assert load_capture(capture_folder).depths == []


def test_depth_maps_pull_splats_to_their_depth(capture: Capture, config: Make, tmp_path: Path) -> None:
    """Maps of the true scene, a start of unknown depth, and the depth error in the views that were trained on."""
    cameras = synthetic_cameras(len(capture), 32, 24)
    truths = []
    for i in range(len(capture)):
        truth = rasterize(*synthetic_scene(), cameras[i], depth="expected")
        assert truth.depth is not None
        truths.append(torch.where(truth.alpha > 0.9, truth.depth, 0.0))
        np.save(tmp_path / f"{i}.npy", truths[-1].numpy())
    capture.depths, capture.points = [tmp_path / f"{i}.npy" for i in range(len(capture))], None
    errors = []
    for weight in (0.0, 0.5):
        scene = fit(capture, config(steps=40, depth_weight=weight), progress=False).gaussians
        renders = [draw(scene, capture.camera(i), depth="expected").depth for i in capture.train]
        errors.append(sum(float((depth[known] / truth[known] - 1).abs().mean().detach()) for depth, truth in
                          zip(renders, (truths[i] for i in capture.train), strict=True) for known in [truth > 0]))      # type: ignore[index]
    assert errors[1] < 0.5 * errors[0]


@pytest.mark.parametrize("one_core", [False, True])
def test_photos_are_read_ahead_by_one_other_thread(one_core: bool) -> None:
    threads, cores = [], torch.get_num_threads()

    class Images:
        def __getitem__(self, index: int) -> torch.Tensor:
            threads.append(threading.current_thread())
            assert torch.get_num_threads() == (1 if one_core else cores)
            if index == 9:
                raise ValueError("photo 9: expected an image")
            return torch.full((1,), float(index))

    with PhotoStream(Images(), one_core=one_core) as stream:      # type: ignore[arg-type]
        assert float(stream[3]) == 3
        stream.prepare(4)
        assert float(stream[5]) == 5                                   # another than was prepared
        stream.prepare(9)
        with pytest.raises(ValueError, match="photo 9"):
            stream[9]
        assert float(stream[2]) == 2
    assert len(set(threads)) == 1
    assert threading.current_thread() not in threads
    assert not threads[0].is_alive()
    assert torch.get_num_threads() == cores


def test_growth_that_does_not_fit_stops_before_it(capture: Capture, config: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tsplat.fit.memory, "free_bytes", lambda device: 10_000)
    c = config(max_splats=1000, density_start=0.4)
    with pytest.raises(MemoryError, match=r"^step 8: growing from 200 to \d+ splats takes about \d+ MiB, and 0 MiB are free on cpu; ask for fewer"):
        fit(capture, c, tmp_path, progress=False)
    monkeypatch.undo()
    steps: list[Step] = []
    result = fit(capture, c, tmp_path, progress=False, callbacks=[steps.append])
    assert steps[0].number == 6                                        # from the checkpoint after step 5
    assert len(result.gaussians) == 1000


def test_estimate_of_memory() -> None:
    scene = Gaussians.random(10)
    floats = sum(p.numel() for p in scene.parameters())
    assert bytes_for(scene, 20) == 2 * (6 * 4 * floats + 10 * 600)
    check_growth(scene, 0, 1, scene.device, 10)
    free = free_bytes(torch.device("cpu"))
    assert free is None or free > 0


MIB = 2**20


@pytest.mark.parametrize(("group", "files", "free"), [
    ("0::/", {}, 5000),
    ("0::/", {"memory.max": "max", "memory.current": 100}, 5000),
    ("0::/", {"memory.max": 1000, "memory.current": 300, "memory.stat": (100, 50)}, 850),
    ("0::/a/b", {"memory.max": 1000, "memory.current": 300}, 700),                                    # a container that sees its own group alone
    ("0::/a/b", {"a/b/memory.max": 1000, "a/b/memory.current": 100, "a/memory.max": 900, "a/memory.current": 300}, 600),      # a group in another
    ("0::/", {"memory.max": 100, "memory.current": 101}, 0),
    ("0::/", {"memory.max": 9000, "memory.current": 100}, 5000),                                      # the machine has less
    ("4:cpu,memory:/a", {"memory/a/memory.limit_in_bytes": 1000, "memory/a/memory.usage_in_bytes": 400, "memory/a/memory.stat": (60, 40)}, 700),
    ("4:memory:/docker/0", {"memory/memory.limit_in_bytes": 1000, "memory/memory.usage_in_bytes": 400}, 600),
    ("4:memory:/", {"memory/memory.limit_in_bytes": (2**63 - 4096) // MIB, "memory/memory.usage_in_bytes": 400}, 5000),       # as it says "none"
])
def test_free_memory_is_that_of_the_container(tmp_path: Path, group: str, files: dict[str, Any], free: int) -> None:
    """From files as Linux has them; all numbers in MiB, those of `memory.stat` are inactive and active pages of files, which can be had."""
    version_1 = group.startswith("4")
    described = {"proc/meminfo": f"MemTotal: {9000 * 1024} kB\nMemAvailable: {5000 * 1024} kB\n", "proc/self/cgroup": f"1:name=systemd:/\n{group}\n"}
    for name, value in files.items():
        if name.endswith("stat"):
            total = "total_" * version_1
            value = f"inactive_file 1\nanon 7\n{total}inactive_file {value[0] * MIB}\n{total}active_file {value[1] * MIB}"
        described[f"sys/fs/cgroup/{name}"] = f"{value if isinstance(value, str) else value * MIB}\n"
    for name, text in described.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    assert free_bytes(torch.device("cpu"), tmp_path) == free * MIB
    assert free_bytes(torch.device("cpu"), tmp_path / "nothing there") is None


def test_estimate_of_memory_of_a_scene_that_is_drawn_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 1000 splats a step drew 100: of 2000 it will draw 200, and its device has to hold these and their gradients."""
    scene, gpu = Gaussians.random(1000), torch.device("cuda")
    each = 4 * sum(p[0].numel() for p in scene.parameters())
    needed = {"cpu": 2000 * (6 * each + 100) - 1000 * (6 * each + 100) * 4 // 6, "cuda": 200 * (2 * each + 600)}
    free = dict(needed)
    monkeypatch.setattr(tsplat.fit.memory, "free_bytes", lambda device: free[device.type])
    check_growth(scene, 1000, 5, gpu, 100)
    for place in needed:
        free.update(needed)
        free[place] -= 1
        with pytest.raises(MemoryError, match=rf"^step 5: growing from 1000 to 2000 splats takes about \d+ MiB, and \d+ MiB are free on {place};"):
            check_growth(scene, 1000, 5, gpu, 100)
