"""The module of spheres and its file."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from tsplat import Gaussians, Spheres


def spheres(n: int = 5, channels: int = 4) -> Spheres:
    g = torch.Generator().manual_seed(0)
    return Spheres(torch.randn(n, 3, generator=g), torch.randn(n, generator=g), torch.randn(n, generator=g),
                   torch.randn(n, channels, generator=g), gamma=0.02, near=0.3, far=7.1)


@pytest.mark.parametrize("channels", [1, 3, 12])
@pytest.mark.parametrize("n", [0, 1, 5])
def test_files_keep_everything(tmp_path: Path, n: int, channels: int) -> None:
    """To float32; a radius is written, and its logarithm read, which rounds twice."""
    s = spheres(n, channels)
    s.save(tmp_path / "s.ply")
    got = Spheres.load(tmp_path / "s.ply")
    assert (got.gamma, got.near, got.far) == (0.02, 0.3, 7.1)
    for name in ("positions", "opacity_logits", "features"):
        assert torch.equal(got.get_parameter(name), s.get_parameter(name)), name
    assert torch.allclose(got.log_radii, s.log_radii, atol=4 * 6e-8, rtol=1e-6)


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    spheres().save(tmp_path / "s.ply")
    before = (tmp_path / "s.ply").read_bytes()
    broken = spheres()
    broken.features.data = broken.features.data[:2]
    with pytest.raises(RuntimeError):
        broken.save(tmp_path / "s.ply")
    assert (tmp_path / "s.ply").read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["s.ply"]


@pytest.mark.parametrize(("content", "message"), [
    (lambda ok: b"photo", "expected a .ply file"), (lambda ok: ok[:-3], "truncated: expected"),
    (lambda ok: ok.replace(b"radius", b"girth_"), "expected spheres"), (lambda ok: ok.replace(b"comment tsplat spheres", b"comment something"),
                                                                        "expected spheres"),
    (lambda ok: ok.replace(b"spheres 0.02", b"spheres soft"), "expected the comment 'tsplat spheres gamma near far'"),
    (lambda ok: ok.replace(b"feature_1", b"feature_9"), "expected columns feature_0, feature_1")])
def test_foreign_and_broken_files(tmp_path: Path, content: object, message: str) -> None:
    path = tmp_path / "s.ply"
    spheres().save(path)
    path.write_bytes(content(path.read_bytes()))  # type: ignore[operator]
    with pytest.raises(ValueError, match=message):
        Spheres.load(path)


def test_a_file_of_gaussians_is_not_one_of_spheres(tmp_path: Path) -> None:
    Gaussians.from_points(torch.rand(4, 3)).save(tmp_path / "g.ply")
    with pytest.raises(ValueError, match="expected spheres, a binary_little_endian .ply with a comment"):
        Spheres.load(tmp_path / "g.ply")
    spheres().save(tmp_path / "s.ply")
    with pytest.raises(ValueError, match="a 3DGS .ply needs the columns"):
        Gaussians.load(tmp_path / "s.ply")


def test_from_points() -> None:
    s = Spheres.from_points(torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), opacity=0.3)
    assert torch.allclose(s.radii[0], torch.tensor(1.0))
    assert torch.allclose(s.opacities, torch.full((4,), 0.3))
    assert s.features.shape == (4, 3)
    for bad, message in (({"opacity": 1.0}, "opacity: expected above 0"), ({"colors": torch.zeros(3, 3)}, "colors: expected shape")):
        with pytest.raises(ValueError, match=message):
            Spheres.from_points(torch.rand(4, 3), **bad)
    with pytest.raises(ValueError, match="1 of 2 points with NaN"):
        Spheres.from_points(torch.tensor([[0, 0, torch.nan], [0, 0, 0]]))


def test_a_saved_state_may_have_another_size() -> None:
    s, other = spheres(5), spheres(8)
    s.load_state_dict(other.state_dict())
    assert len(s) == 8
    assert torch.equal(s.features, other.features)


@pytest.mark.parametrize(("name", "shape", "message"), [("positions", (5, 2), "positions: expected shape"), ("log_radii", (4,), "log_radii"),
                                                        ("features", (5, 0), "features: expected at least 1 channel")])
def test_errors_say_what_is_expected(name: str, shape: tuple[int, ...], message: str) -> None:
    tensors = {k: v.detach() for k, v in spheres().named_parameters()}
    with pytest.raises(ValueError, match=message):
        Spheres(**{**tensors, name: torch.zeros(shape)})
