"""The procedural capture: its geometry, and its files through the normal loader."""

from pathlib import Path

import pytest
import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix

from tsplat.scene import load_capture, synthetic_cameras, synthetic_scene, write_synthetic_capture


def test_scene() -> None:
    means, quats, scales, opacities, colors = synthetic_scene()
    n = len(means)
    assert 3000 < n < 15_000
    assert (quats.shape, scales.shape, opacities.shape, colors.shape) == ((n, 4), (n, 3), (n,), (n, 3))
    assert all(tensor.dtype == torch.float32 for tensor in (means, quats, scales, opacities, colors))
    assert (scales > 0).all()
    assert ((opacities > 0) & (opacities < 1)).all()
    assert ((colors >= 0) & (colors <= 1)).all()
    assert means.norm(dim=1).max() < 2
    torch.testing.assert_close(quats.norm(dim=1), torch.ones(n))
    assert torch.equal(means, synthetic_scene()[0])
    assert torch.equal(colors, synthetic_scene(0)[4])
    assert not torch.equal(colors, synthetic_scene(1)[4])


def test_splats_lie_in_their_surfaces() -> None:
    means, quats, *_ = synthetic_scene()
    normals = quaternion_to_rotation_matrix(quats)[:, :, 2]          # the flat axis
    ground = means[:, 1] == 0
    torch.testing.assert_close(normals[ground][:, 1].abs(), torch.ones(int(ground.sum())))
    centre = torch.tensor([0.0, -0.45, 0.0])
    sphere = ((means - centre).norm(dim=1) - 0.45).abs() < 1e-4
    assert sphere.sum() >= 3000
    torch.testing.assert_close(normals[sphere], (means[sphere] - centre) / 0.45, atol=1e-4, rtol=0)


def test_cameras_see_the_scene() -> None:
    means, *_ = synthetic_scene()
    cameras = synthetic_cameras(12, 160, 120)
    assert len(cameras) == 12
    seen = means @ cameras.viewmats[:, :3, :3].mT + cameras.viewmats[:, None, :3, 3]       # [C, N, 3]
    pixels = seen @ cameras.Ks.mT
    pixels = pixels[..., :2] / pixels[..., 2:]
    inside = ((pixels > 0) & (pixels < torch.tensor([160, 120]))).all(-1)
    assert (seen[..., 2] > 0.5).all()
    assert inside.float().mean(1).min() > 0.8
    eyes = -(cameras.viewmats[:, :3, :3].mT @ cameras.viewmats[:, :3, 3:])[..., 0]
    assert eyes[:, 1].unique().numel() == 2


def test_written_capture(tmp_path: Path) -> None:
    pytest.importorskip("tsplat.rasterize", reason="the renderer is needed")
    folder = write_synthetic_capture(tmp_path / "new" / "capture", views=9, size=(80, 60), seed=1)
    capture = load_capture(folder)
    assert len(capture) == 9
    assert capture.test == [0, 8]
    cameras = synthetic_cameras(9, 80, 60)
    torch.testing.assert_close(capture.viewmats, cameras.viewmats, atol=1e-6, rtol=0)
    torch.testing.assert_close(capture.Ks, cameras.Ks)
    assert capture.points is not None
    assert capture.points.shape == (3000, 3)
    image = capture.images[0]
    assert image.shape == (60, 80, 3)
    assert (image.sum(-1) > 0).float().mean() > 0.4                  # the scene fills much of the photo
    assert image.std() > 0.15
