"""The container: construction, activations, initialisation, state that changes size."""

import math
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tsplat.scene import Gaussians


def raw(n: int, degree: int = 1) -> dict[str, Tensor]:
    rest = (degree + 1) ** 2 - 1
    shapes = {"means": (n, 3), "quats": (n, 4), "log_scales": (n, 3), "opacity_logits": (n,), "sh0": (n, 1, 3),
              "sh_rest": (n, rest, 3)}
    return {name: torch.randn(shape) for name, shape in shapes.items()}


@pytest.mark.parametrize("degree", range(5))
@pytest.mark.parametrize("n", [0, 1, 5])
def test_activations(n: int, degree: int) -> None:
    tensors = raw(n, degree)
    gaussians = Gaussians(**tensors)
    assert len(gaussians) == n
    assert gaussians.sh_degree == degree
    assert gaussians.sh.shape == (n, (degree + 1) ** 2, 3)
    torch.testing.assert_close(gaussians.scales, tensors["log_scales"].exp())
    torch.testing.assert_close(gaussians.opacities, tensors["opacity_logits"].sigmoid())
    assert [name for name, _ in gaussians.named_parameters()] == list(Gaussians.NAMES)
    assert all(parameter.requires_grad for parameter in gaussians.parameters())
    assert str(n) in repr(gaussians)


@pytest.mark.parametrize(("name", "shape"), [("means", (4, 2)), ("quats", (4, 3)), ("log_scales", (3, 3)),
                                             ("opacity_logits", (4, 1)), ("sh0", (4, 3)), ("sh_rest", (4, 4, 3))])
def test_wrong_shape_names_the_argument(name: str, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        Gaussians(**{**raw(4), name: torch.zeros(shape)})


def test_wrong_type_names_the_argument() -> None:
    with pytest.raises(TypeError, match="sh0: expected dtype"):
        Gaussians(**{**raw(4), "sh0": torch.zeros(4, 1, 3, dtype=torch.float64)})
    with pytest.raises(TypeError, match="means: expected a floating-point"):
        Gaussians(**{**raw(4), "means": torch.zeros(4, 3, dtype=torch.int32)})


def test_from_points() -> None:
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [10, 10, 10]])
    colors = torch.rand(5, 3)
    gaussians = Gaussians.from_points(points, colors, sh_degree=2, opacity=0.2)
    torch.testing.assert_close(gaussians.scales[0], torch.full((3,), math.sqrt((1 + 4 + 9) / 3)))
    torch.testing.assert_close(0.28209479177387814 * gaussians.sh0[:, 0] + 0.5, colors)
    torch.testing.assert_close(gaussians.opacities, torch.full((5,), 0.2))
    assert gaussians.quats.tolist() == [[1, 0, 0, 0]] * 5
    assert gaussians.sh_degree == 2
    assert not gaussians.sh_rest.any()


@pytest.mark.parametrize("n", [0, 1, 2, 3])
def test_from_few_points(n: int) -> None:
    gaussians = Gaussians.from_points(torch.arange(3.0 * n).view(n, 3), sh_degree=0)
    assert len(gaussians) == n
    assert gaussians.log_scales.isfinite().all()
    assert not gaussians.sh0.any()                                  # mid grey


def test_from_coincident_points() -> None:
    scales = Gaussians.from_points(torch.ones(10, 3)).scales
    torch.testing.assert_close(scales, torch.full((10, 3), 1e-7))


def test_from_points_refuses() -> None:
    points = torch.zeros(4, 3)
    points[1, 2] = torch.nan
    with pytest.raises(ValueError, match="points: expected finite coordinates; got 1 of 4"):
        Gaussians.from_points(points)
    with pytest.raises(ValueError, match="colors: expected shape"):
        Gaussians.from_points(torch.zeros(4, 3), torch.zeros(3, 3))
    with pytest.raises(ValueError, match="sh_degree"):
        Gaussians.from_points(torch.zeros(4, 3), sh_degree=5)
    with pytest.raises(ValueError, match="opacity"):
        Gaussians.from_points(torch.zeros(4, 3), opacity=1.0)


def test_random() -> None:
    def make() -> Gaussians:
        return Gaussians.random(200, low=[-1, 0, 5], high=[1, 0.5, 6], sh_degree=1, generator=torch.Generator().manual_seed(3))

    gaussians = make()
    low, high = gaussians.means.amin(0), gaussians.means.amax(0)
    assert (low >= torch.tensor([-1, 0, 5])).all()
    assert (high <= torch.tensor([1, 0.5, 6])).all()
    assert torch.equal(gaussians.means, make().means)
    assert len(Gaussians.random(0)) == 0
    with pytest.raises(ValueError, match="low < high"):
        Gaussians.random(3, low=1, high=1)


@pytest.mark.parametrize(("n", "degree"), [(7, 1), (0, 1), (3, 2), (5, 0)])
def test_state_of_another_size(n: int, degree: int) -> None:
    source, target = Gaussians(**raw(n, degree)), Gaussians(**raw(5, 1))
    parameter = target.means
    target.sh.sum().backward()
    target.load_state_dict(source.state_dict())
    assert target.means is parameter                                 # an optimiser keeps its hold on it
    assert len(target) == n
    for name in Gaussians.NAMES:
        assert torch.equal(getattr(target, name), getattr(source, name))
    (target.means.sum() + target.sh.sum()).backward()


def test_state_within_a_module() -> None:
    outer = torch.nn.ModuleDict({"scene": Gaussians(**raw(2))})
    outer.load_state_dict(torch.nn.ModuleDict({"scene": Gaussians(**raw(6))}).state_dict())
    scene = outer["scene"]
    assert isinstance(scene, Gaussians)
    assert len(scene) == 6


def test_inconsistent_state_changes_nothing() -> None:
    gaussians = Gaussians(**raw(4))
    with pytest.raises(ValueError, match="quats: expected shape"):
        gaussians.load_state_dict({**gaussians.state_dict(), "means": torch.zeros(5, 3)})
    with pytest.raises(RuntimeError, match="Missing key"):
        gaussians.load_state_dict({"means": torch.zeros(5, 3)})
    assert len(gaussians) == 4


@pytest.mark.parametrize("name", ["scene.obj", "scene", "scene.ply.gz"])
def test_unknown_suffix(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match=r"ends in \.ply"):
        Gaussians.load(tmp_path / name)
    with pytest.raises(ValueError, match=r"ends in \.ply"):
        Gaussians(**raw(1)).save(tmp_path / name)


def test_import_leaves_kornia_alone() -> None:
    code = "import sys, tsplat.scene; assert not any(name.split('.')[0] == 'kornia' for name in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).resolve().parents[2])
