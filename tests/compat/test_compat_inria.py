"""The drop-in for diff_gaussian_rasterization against a plain implementation of its rules."""

from __future__ import annotations

import dataclasses
import inspect
import math
from typing import Any

import plain_inria
import pytest
import torch
from backends import Backend, reference_again
from compare import assert_close, leaves
from torch import Tensor

from tsplat.compat.inria import GaussianRasterizationSettings, GaussianRasterizer, rasterize_gaussians

WIDTH, HEIGHT = 52, 41                                  # with tiles of 16 that reach beyond the image
N = 60


def settings(*, offset: tuple[float, float] = (0.0, 0.0), **changes: Any) -> GaussianRasterizationSettings:
    """A turned camera at (0.3, -0.2, -4), with matrices as the training code makes them."""
    tanfovx, tanfovy = 0.5, 0.5 * HEIGHT / WIDTH * 1.1
    axis = torch.tensor([[0.0, 0.05, 0.1], [-0.05, 0.0, -0.03], [-0.1, 0.03, 0.0]], dtype=torch.float64)
    R = torch.linalg.matrix_exp(axis)
    campos = torch.tensor([0.3, -0.2, -4.0], dtype=torch.float64)
    V, P = torch.eye(4, dtype=torch.float64), torch.zeros(4, 4, dtype=torch.float64)
    V[:3, :3], V[:3, 3] = R, -R @ campos
    near, far = 0.01, 100.0
    P[0, 0], P[1, 1], P[2, 2], P[2, 3], P[3, 2] = 1 / tanfovx, 1 / tanfovy, far / (far - near), -far * near / (far - near), 1.0
    P[0, 2], P[1, 2] = offset
    values = {"image_height": HEIGHT, "image_width": WIDTH, "tanfovx": tanfovx, "tanfovy": tanfovy,
              "bg": torch.tensor([0.1, 0.5, 0.9], dtype=torch.float64), "scale_modifier": 1.3, "viewmatrix": V.T.contiguous(),
              "projmatrix": (P @ V).T.contiguous(), "sh_degree": 1, "campos": campos, "prefiltered": False, "debug": False, "antialiasing": False}
    return GaussianRasterizationSettings(**(values | changes))


@dataclasses.dataclass
class Scene:
    """Leaves."""

    means3D: Tensor
    means2D: Tensor
    opacities: Tensor
    shs: Tensor
    colors: Tensor
    scales: Tensor
    rotations: Tensor
    covs: Tensor

    def arguments(self, harmonics: bool, covariances: bool) -> dict[str, Tensor]:
        shape = {"cov3D_precomp": self.covs} if covariances else {"scales": self.scales, "rotations": self.rotations}
        return {"means3D": self.means3D, "means2D": self.means2D, "opacities": self.opacities,
                **({"shs": self.shs} if harmonics else {"colors_precomp": self.colors}), **shape}


def scene() -> Scene:
    """Inside and outside of the image and near plane, some nearly transparent, some larger than others; rotations of unit length."""
    g = torch.Generator().manual_seed(4)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    means = normal(N, 3) * torch.tensor([1.4, 1.2, 1.8])
    means[:3, 2] = torch.tensor([-3.85, -3.7, -6.0])
    opacities = torch.rand(N, 1, generator=g, dtype=torch.float64)
    opacities[3:6, 0] = torch.tensor([1e-3, 0.9999, 1.0])
    scales = (normal(N, 3) * 0.7 - 2.5).exp()
    rotations = torch.nn.functional.normalize(normal(N, 4), dim=1)
    F = normal(N, 3, 3) * 0.12
    S = F @ F.mT
    covs = torch.stack([S[:, i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))], 1)
    tensors = leaves(means, torch.zeros(N, 3, dtype=torch.float64), opacities, normal(N, 4, 3) * 0.4,
                     torch.rand(N, 3, generator=g, dtype=torch.float64), scales, rotations, covs)
    return Scene(*tensors)


def plainly(s: GaussianRasterizationSettings, v: Scene, harmonics: bool, covariances: bool, *, cut: bool) -> tuple[Tensor, Tensor, Tensor]:
    return plain_inria.render(s, v.means3D, v.means2D[:, :2], v.opacities[:, 0], v.shs if harmonics else None, None if harmonics else v.colors,
                              None if covariances else v.scales, None if covariances else v.rotations, v.covs if covariances else None, cut=cut)


def loss_of(image: Tensor, inverse: Tensor) -> Tensor:
    w = torch.sin(torch.arange(image.numel(), dtype=image.dtype)).view_as(image)
    return (w * image).sum() + (w[:1] * inverse).sum()


@pytest.mark.parametrize("antialiasing", [False, True])
@pytest.mark.parametrize("covariances", [False, True])
@pytest.mark.parametrize("harmonics", [False, True])
def test_images_radii_depths_and_gradients(harmonics: bool, covariances: bool, antialiasing: bool) -> None:
    """Of everything, `means2D` in NDC. That of a rotation is compared across its length, along which the plain one does not normalise."""
    s, v = settings(antialiasing=antialiasing), scene()
    arguments = v.arguments(harmonics, covariances)
    image, radii, inverse = GaussianRasterizer(raster_settings=s)(**arguments)
    want, want_radii, want_inverse = plainly(s, v, harmonics, covariances, cut=False)
    assert image.shape == (3, HEIGHT, WIDTH)
    assert inverse.shape == (1, HEIGHT, WIDTH)
    assert 20 < (want_radii > 0).sum() < N
    assert torch.equal(radii, want_radii)
    assert_close([image, inverse], [want, want_inverse], 1e-12)
    inputs = list(arguments.values())
    found, expected = (list(torch.autograd.grad(loss_of(i, d), inputs)) for i, d in ((image, inverse), (want, want_inverse)))
    if not covariances:
        along = (expected[-1] * v.rotations).sum(1, keepdim=True) * v.rotations
        expected[-1] = (expected[-1] - along).detach()
    for name, got, gradient in zip(arguments, found, expected, strict=True):
        assert gradient.abs().max() > 0, name
        assert_close(got, gradient, 1e-10)


def test_on_the_kernels(backend: Backend) -> None:
    """The Triton kernels take what this makes of the arguments."""
    s, v = settings(image_height=15, image_width=21), scene()
    arguments = {k: t.detach()[:12] for k, t in v.arguments(True, False).items()}
    with reference_again():
        want = GaussianRasterizer(s)(**arguments)
    on = GaussianRasterizationSettings(*(backend.put(x) for x in s))
    got = GaussianRasterizer(on)(**{k: backend.put(t) for k, t in arguments.items()})
    assert torch.equal(got[1].cpu(), want[1])
    assert_close([got[0], got[2]], [want[0], want[2]], 1e-12)


def test_alpha_is_at_most_099() -> None:
    """Of a black splat of opacity 1 that covers the image, a hundredth of the background is left; the gradient where it is clamped is 0."""
    s, v = settings(), scene()
    splat = Scene(*(getattr(v, field.name).detach()[5:6] for field in dataclasses.fields(v)))
    splat.means3D[:], splat.scales[:], splat.colors[:] = 0.0, 30.0, 0.0
    splat.opacities.requires_grad_()
    image, _, _ = GaussianRasterizer(s)(**splat.arguments(False, False))
    want, _, _ = plainly(s, splat, False, False, cut=True)
    assert_close(image, want, 1e-12)
    assert_close(image, (0.01 * s.bg[:, None, None]).expand_as(image), 1e-12)
    image.sum().backward()
    assert splat.opacities.grad == 0


def test_what_inria_cuts_off_at_its_tiles() -> None:
    """With the cut, the plain image differs by no more than the opacity beyond 3 standard deviations, exp(-4.5), of each splat there."""
    s, v = settings(scale_modifier=3.0), scene()
    with torch.no_grad():
        v.opacities.clamp_min_(0.9)
        image, _, _ = GaussianRasterizer(s)(**v.arguments(False, False))
        cut, _, _ = plainly(s, v, False, False, cut=True)
    difference = (image - cut).abs().amax(0)
    assert 0 < (difference > 1e-6).float().mean() < 0.2
    assert difference.max() <= 2 * math.exp(-4.5)


def test_the_principal_point_of_the_projection() -> None:
    """Splats well inside the image, where no Jacobian is limited, are where the projection says."""
    s, v = settings(offset=(0.1, -0.2)), scene()
    v.means3D = (v.means3D.detach() * 0.3).requires_grad_()
    with torch.no_grad():
        image, radii, _ = GaussianRasterizer(s)(**v.arguments(True, False))
        want, want_radii, _ = plainly(s, v, True, False, cut=False)
        centred, _, _ = GaussianRasterizer(settings())(**v.arguments(True, False))
    assert torch.equal(radii, want_radii)
    assert_close(image, want, 1e-12)
    assert (image - centred).abs().max() > 0.1


def test_mark_visible() -> None:
    s, v = settings(), scene()
    z = torch.cat([v.means3D, torch.ones(N, 1)], 1) @ s.viewmatrix
    marked = GaussianRasterizer(s).markVisible(v.means3D)
    assert torch.equal(marked, z[:, 2] > 0.2)
    assert 0 < (~marked).sum() < N


def test_the_pose_has_a_gradient() -> None:
    """Of the view matrix, along a turn and a shift, against central differences; Inria's has none."""
    base, v = settings(), scene()
    P = torch.linalg.solve(base.viewmatrix, base.projmatrix)
    w = torch.randn(3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    generator = torch.tensor([[0.0, 0.3, -0.5, 0.0], [-0.3, 0.0, 0.2, 0.0], [0.5, -0.2, 0.0, 0.0], [0.4, -0.1, 0.6, 0.0]], dtype=torch.float64)

    def function(t: Tensor) -> Tensor:
        viewmatrix = base.viewmatrix @ torch.linalg.matrix_exp(t * generator)
        return (w * GaussianRasterizer(base._replace(viewmatrix=viewmatrix, projmatrix=viewmatrix @ P))(**v.arguments(False, False))[0]).sum()

    t = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(function(t), t)
    with torch.no_grad():
        h = torch.tensor(1e-6, dtype=torch.float64)
        assert gradient.item() == pytest.approx(((function(h) - function(-h)) / (2 * h)).item(), rel=1e-6)


def test_names_order_and_defaults() -> None:
    assert GaussianRasterizationSettings._fields == (
        "image_height", "image_width", "tanfovx", "tanfovy", "bg", "scale_modifier", "viewmatrix", "projmatrix", "sh_degree", "campos", "prefiltered",
        "debug", "antialiasing")
    names = "self means3D means2D opacities shs colors_precomp scales rotations cov3D_precomp"
    assert " ".join(inspect.signature(GaussianRasterizer.forward).parameters) == names
    names = "means3D means2D sh colors_precomp opacities scales rotations cov3Ds_precomp raster_settings"
    assert " ".join(inspect.signature(rasterize_gaussians).parameters) == names


def test_empty_tensors_are_no_arguments() -> None:
    """As the function of that name takes them."""
    s, v = settings(), scene()
    none = torch.Tensor([])
    got = rasterize_gaussians(v.means3D, v.means2D, none, v.colors, v.opacities, v.scales, v.rotations, none, s)
    assert_close(got[0], GaussianRasterizer(s)(**v.arguments(False, False))[0], 0.0)


def test_nothing_to_draw() -> None:
    s, v = settings(), scene()
    for some in ({k: t[:0] for k, t in v.arguments(False, False).items()}, v.arguments(False, False) | {"means3D": v.means3D - 100}):
        image, radii, inverse = GaussianRasterizer(s)(**some)
        assert_close(image, s.bg[:, None, None].expand_as(image), 0.0)
        assert (radii == 0).all()
        assert (inverse == 0).all()
        image.sum().backward()


@pytest.mark.parametrize("name", ["means3D", "opacities", "scales", "rotations", "colors_precomp"])
def test_splats_that_are_not_finite_are_left_out(name: str) -> None:
    s, v = settings(), scene()
    arguments = {k: t.detach().clone() for k, t in v.arguments(False, False).items()}
    want, _, _ = GaussianRasterizer(s)(**{k: t[1:] for k, t in arguments.items()})
    arguments[name][0] = math.nan
    leaf = arguments["means3D"].requires_grad_()
    image, _, _ = GaussianRasterizer(s)(**arguments)
    assert_close(image, want, 1e-14)
    image.sum().backward()
    assert leaf.grad is not None
    assert leaf.grad.isfinite().all()


@pytest.mark.parametrize(("change", "message"), [
    ({"shs": torch.zeros(N, 4, 3, dtype=torch.float64)}, "shs, colors_precomp: expected exactly one"), ({"scales": None}, "scales, rotations, cov3D"),
    ({"cov3D_precomp": torch.zeros(N, 6, dtype=torch.float64)}, "scales, rotations, cov3D"),
    ({"means2D": torch.zeros(N, 2, dtype=torch.float64)}, "means2D: expected shape"),
    ({"opacities": torch.zeros(3, dtype=torch.float64)}, "opacities: expected shape"),
    ({"colors_precomp": None, "shs": torch.zeros(N, 1, 3, dtype=torch.float64)}, "shs: expected at least 4")])
def test_arguments_that_are_wrong(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        GaussianRasterizer(settings())(**(scene().arguments(False, False) | change))
    with pytest.raises(ValueError, match="bg: expected shape"):
        GaussianRasterizer(settings(bg=torch.zeros(2, dtype=torch.float64)))(**scene().arguments(False, False))
