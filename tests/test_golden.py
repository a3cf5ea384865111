"""Against recorded results of gsplat's reference (float64, rounded to float32 in the file), of gsplat on CUDA, and real trained
scenes.

Where a pixel saturates gsplat drops the splat that takes the light below 1e-4, and tsplat keeps it (see `reference.blend`).
That splat weighs up to 1e-4 alpha_max / (1 - alpha_max) = 9.9e-3, so there the two must differ. `plain.py` has both rules: with
the peers' it gives the recorded numbers everywhere, gradients included; with ours it is what the other tests hold tsplat
against.
"""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy
import plain
import pytest
import torch
import tsplat_reference as reference
from backends import Backend
from compare import assert_close, error, leaves
from torch import Tensor

from tsplat import Camera, Gaussians, ops, rasterize

WITHOUT_INTERPRETER = True           # minutes there
ROUNDING = 6e-8
"""Half an ulp of float32, relative: what is left of numbers that were computed in float64 and stored in float32."""
INPUTS = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "backgrounds")
WITH_GRADIENT = tuple(name for name in INPUTS if name != "Ks")
CASES = [("random_anisotropic_edge_pinhole", None), ("random_batch2x3_rgbed", 0), ("random_batch2x3_rgbed", 1)]


@dataclass(eq=False)
class Golden:
    """One scene of a file."""

    arrays: dict[str, Tensor]
    width: int
    height: int
    eps2d: float
    alpha_max: float
    depth: str | None

    def __getitem__(self, name: str) -> Tensor:
        return self.arrays[name]

    @property
    def calm(self) -> Tensor:
        """`[C, H, W]`: pixels in which no splat is dropped by the peers' rule."""
        return ~self["saturated"]


@functools.cache
def load(path: Path, index: int | None) -> Golden:
    """A file, or one scene of its batch; floating-point numbers as float64."""
    with numpy.load(path) as file:
        config = json.loads(str(file["config"]))
        arrays = {name: torch.from_numpy(file[name]) for name in file.files if name != "config"}
    if index is not None:
        arrays = {name: a[index] for name, a in arrays.items() if a.ndim > 1 and len(a) == 2}
    arrays = {name: a.double() if a.is_floating_point() else a for name, a in arrays.items()}
    assert config["camera_model"] == "pinhole"
    assert config["rasterize_mode"] == "classic"
    return Golden(arrays, config["width"], config["height"], config["eps2d"], config["max_alpha"],
                  "expected" if config["render_mode"] == "RGB+ED" else None)


@pytest.fixture(params=CASES, ids=lambda c: f"{c[0]}-{c[1]}")
def golden(request: pytest.FixtureRequest, shared: Path) -> Golden:
    """Each recorded scene."""
    name, index = request.param
    return load(shared / "golden" / "gsplat" / f"{name}.npz", index)


def channels(image: Tensor, depth: Tensor | None) -> Tensor:
    return image if depth is None else torch.cat([image, depth[..., None]], -1)


def ours(golden: Golden, backend: Backend, drop_last: bool = False) -> tuple[Tensor, Tensor, list[Tensor], Tensor, Tensor]:
    """Image, alpha, leaves, zero screen offset and probe of the absolute gradient, through `rasterize`."""
    inputs = leaves(*(backend.put(golden[name]) for name in INPUTS))
    *splats, viewmats, Ks, background = inputs
    offset, probe = (torch.zeros(len(viewmats), len(splats[0]), 2, dtype=backend.dtype, device=backend.device,
                                 requires_grad=True)
                     for _ in range(2))
    r = rasterize(*splats, Camera(viewmats, Ks, golden.width, golden.height), background=background, depth=golden.depth,
                  eps2d=golden.eps2d, alpha_max=golden.alpha_max, drop_last=drop_last, screen_offset=offset, absgrad=probe)
    return channels(r.image, r.depth), r.alpha, inputs, offset, probe


def plainly(golden: Golden, drop_last: bool) -> tuple[Tensor, Tensor, list[Tensor], Tensor]:
    """The same through `plain`, with the peers' rule if `drop_last`."""
    inputs = leaves(*(golden[name] for name in INPUTS))
    *splats, viewmats, Ks, background = inputs
    offset = torch.zeros(len(viewmats), len(splats[0]), 2, dtype=torch.float64, requires_grad=True)
    image, alpha, depth = plain.render(*splats, viewmats, Ks, golden.width, golden.height, background=background,
                                       depth=golden.depth, eps2d=golden.eps2d, alpha_max=golden.alpha_max, screen_offset=offset,
                                       drop_last=drop_last)
    return channels(image, depth), alpha, inputs, offset


def recorded_loss(golden: Golden, image: Tensor, alpha: Tensor, where: Tensor | None = None) -> Tensor:
    """The loss whose gradients were recorded, or that of some pixels."""
    where = torch.ones_like(golden["saturated"]) if where is None else where
    return (image.cpu() * golden["loss_w"] * where[..., None]).sum() + (alpha.cpu() * golden["loss_v"][..., 0] * where).sum()


def gradients_of(loss: Tensor, inputs: list[Tensor], offset: Tensor) -> list[Tensor]:
    """In the order of WITH_GRADIENT, and means2d."""
    chosen = [x for name, x in zip(INPUTS, inputs, strict=True) if name in WITH_GRADIENT]
    return list(torch.autograd.grad(loss, [*chosen, offset], retain_graph=True))


@functools.cache
def peers(golden: Golden) -> tuple[Tensor, Tensor, list[Tensor], list[Tensor]]:
    """Image and alpha of `plain` with the peers' rule, and the gradients of the recorded loss: of all pixels, and of the calm
    ones.
    """
    image, alpha, inputs, offset = plainly(golden, drop_last=True)
    losses = recorded_loss(golden, image, alpha), recorded_loss(golden, image, alpha, golden.calm)
    return image.detach(), alpha.detach(), *(gradients_of(loss, inputs, offset) for loss in losses)


def assert_rounds_to(got: Tensor, want: Tensor, where: Tensor) -> None:
    """Equal to a float32 number of the file but for its rounding."""
    difference = (got.cpu() - want).abs() - ROUNDING * want.abs()
    assert difference[where].max() <= 1e-12


def test_pixels_that_do_not_saturate_are_the_recorded_ones(golden: Golden, backend: Backend) -> None:
    """Asked for: 1e-6. It is the rounding of the file, in unstable pixels, too."""
    image, alpha, *_ = ours(golden, backend)
    assert (golden["stable"] & golden.calm).float().mean() > 0.97
    where = golden["stable"] & golden.calm
    assert_rounds_to(image, golden["f64_render_colors"], where)
    assert_rounds_to(alpha, golden["f64_render_alphas"][..., 0], where)


def test_the_plain_formulation_with_the_peers_stop_is_the_recording(golden: Golden) -> None:
    """In all pixels and all gradients, so that it may stand for the peers below."""
    image, alpha, found, _ = peers(golden)
    everywhere = torch.ones_like(golden["saturated"])
    assert_rounds_to(image, golden["f64_render_colors"], everywhere)
    assert_rounds_to(alpha, golden["f64_render_alphas"][..., 0], everywhere)
    assert_close(found, [golden[f"f64_v_{name}"] for name in (*WITH_GRADIENT, "means2d")], ROUNDING)


def test_gradients_from_pixels_that_do_not_saturate_are_the_peers(golden: Golden, backend: Backend) -> None:
    """Asked for: 1e-5 of the largest. The file's own gradients mix saturated pixels in; the loss here leaves them out on both
    sides.
    """
    image, alpha, inputs, offset, _ = ours(golden, backend)
    assert_close(gradients_of(recorded_loss(golden, image, alpha, golden.calm), inputs, offset), peers(golden)[3], 1e-12)


def test_with_the_peers_end_of_a_pixel_all_is_as_recorded(golden: Golden, backend: Backend) -> None:
    """Images and gradients, where pixels saturate, too. Asked for: 1e-6 and 1e-5, and there 1.5e-4 and 1e-3. It is the file's rounding."""
    image, alpha, inputs, offset, probe = ours(golden, backend, drop_last=True)
    everywhere = torch.ones_like(golden["saturated"])
    assert_rounds_to(image, golden["f64_render_colors"], everywhere)
    assert_rounds_to(alpha, golden["f64_render_alphas"][..., 0], everywhere)
    loss = recorded_loss(golden, image, alpha)
    found = gradients_of(loss, inputs, offset)
    assert_close(found, [golden[f"f64_v_{name}"] for name in (*WITH_GRADIENT, "means2d")], ROUNDING)
    v_abs, = torch.autograd.grad(loss, probe)
    assert error(v_abs, golden["v_means2d_abs"]) <= ROUNDING


def test_where_pixels_saturate_we_are_closer_to_the_exact_sum_than_the_peers(golden: Golden, backend: Backend,
                                                                            monkeypatch: pytest.MonkeyPatch) -> None:
    """Ours within 1e-4 of the sum over all splats; the peers up to 9.9e-3 off, and so is the difference of the two.

    Measured: 7.0e-3 in the image, 9.2e-3 in alpha. (Asked for was 1.5e-4, which no rule that is within 1e-4 of the exact sum
    can meet.)
    """
    image, alpha, *_ = ours(golden, backend)
    with torch.no_grad():
        same, same_alpha, *_ = plainly(golden, drop_last=False)
        monkeypatch.setattr(plain, "STOP", -1.0)
        exact, exact_alpha, *_ = plainly(golden, drop_last=False)
    assert_close([image[..., :3], alpha], [same[..., :3], same_alpha], 1e-13)
    assert (image[..., :3].cpu() - exact[..., :3]).abs().max() <= 1e-4
    assert (alpha.cpu() - exact_alpha).abs().max() <= 1e-4
    recorded, recorded_alpha = golden["f64_render_colors"][..., :3], golden["f64_render_alphas"][..., 0]
    dropped = (alpha.cpu() - recorded_alpha)[golden["saturated"]]
    if len(dropped):
        assert -1e-7 <= dropped.min()
        assert 1e-3 < dropped.max() <= 9.3e-3
        assert (image[..., :3].cpu() - recorded).abs()[golden["saturated"]].max() <= 7.1e-3
        assert (exact[..., :3] - recorded).abs().max() > 10 * (exact[..., :3] - image[..., :3].cpu()).abs().max()


def test_projection_is_the_recorded_one(golden: Golden, backend: Backend) -> None:
    """The intermediates were recorded in float32, with its rounding errors: in the conics 6e-6 of the largest where they are
    thin.
    """
    args = [backend.put(golden[name]) for name in INPUTS]
    got = ops.project(*args[:3], None, args[3], args[5], args[6], golden.width, golden.height, "pinhole", 0.01, 1e10,
                      golden.eps2d, False)
    assert torch.equal(got.radii.cpu(), golden["radii_opacity_aware"])
    visible = (got.radii > 0).all(-1).cpu()
    for name, tolerance in (("means2d", 1.3e-7), ("depths", 7e-8), ("conics", 7e-6)):
        assert error(getattr(got, name).cpu()[visible], golden[name][visible]) <= tolerance, name


@pytest.mark.parametrize("index", [0, 1])
def test_gradients_of_the_intermediates_are_the_recorded_ones(shared: Path, backend: Backend, index: int) -> None:
    """Of conics, depths, and opacities and colours of each view, in the scenes in which nothing saturates."""
    golden = load(shared / "golden" / "gsplat" / "random_batch2x3_rgbed.npz", index)
    args = [backend.put(golden[name]) for name in INPUTS]
    p = ops.project(*args[:3], None, args[3], args[5], args[6], golden.width, golden.height, "pinhole", 0.01, 1e10,
                    golden.eps2d, False)
    means2d, conics, depths, opacities, colors = leaves(p.means2d, p.conics, p.depths, args[3].expand(3, -1),
                                                        args[4].expand(3, -1, -1))
    bins = ops.bin_splats(means2d, p.radii, conics, opacities, depths, golden.width, golden.height, 8)
    background = torch.cat([args[7], torch.zeros_like(args[7][:, :1])], 1)
    image, alpha = ops.blend(means2d, conics, opacities, torch.cat([colors, depths[..., None]], -1), background, None, *bins,
                             golden.width, golden.height, 8, golden.alpha_max)
    image = torch.cat([image[..., :3], image[..., 3:] / alpha[..., None].clamp_min(1e-10)], -1)
    found = torch.autograd.grad(recorded_loss(golden, image, alpha), [means2d, conics, depths, opacities, colors])
    names = "means2d", "conics", "depths", "opacities_view", "colors_view"
    assert_close(found, [golden[f"f64_v_{name}"] for name in names], ROUNDING)


def test_tiles_are_between_the_exact_ones_and_those_of_the_accurate_rule(golden: Golden) -> None:
    """Exact <= ours <= AccuTile <= box for each splat; in all 3,070 against 3,066 and 3,216 on the anisotropic scene, else the
    exact ones.
    """
    args = [golden[name] for name in INPUTS]
    p = reference.project(*args[:3], None, args[3], args[5], args[6], golden.width, golden.height, "pinhole", 0.01, 1e10,
                    golden.eps2d, False)
    C, N = p.depths.shape
    bins = reference.bin_splats(p.means2d, p.radii, p.conics, args[3].expand(C, -1), p.depths, golden.width, golden.height, 16)
    count = torch.bincount(bins.ids.long(), minlength=C * N).view(C, N)
    exact, accurate, box = (golden[f"tiles_per_gauss{name}"] for name in ("_exact", "_accutile", ""))
    assert (exact <= count).all()
    assert (count <= accurate).all()
    assert (accurate <= box).all()
    assert count.sum() <= 1.002 * exact.sum()


# Units


@pytest.fixture
def units(shared: Path) -> Any:
    """Loader of the unit files in float64."""
    def read(name: str) -> dict[str, Tensor]:
        with numpy.load(shared / "golden" / "gsplat" / f"{name}.npz") as file:
            return {k: torch.from_numpy(file[k]).double() for k in file.files}
    return read


def test_covariances_are_the_recorded_ones(units: Any) -> None:
    file = units("unit_covar")
    quats, scales = leaves(file["quats"], file["scales"])
    covars = reference.covariances(quats, scales)
    precisions = torch.linalg.inv(covars)
    assert_close([covars, precisions], [file["f64_covar"], file["f64_preci"]], ROUNDING)
    loss = (covars * file["w_covar"]).sum() + (precisions * file["w_preci"]).sum()
    assert_close(torch.autograd.grad(loss, [quats, scales]), [file["f64_v_quats"], file["f64_v_scales"]], ROUNDING)


@pytest.mark.parametrize("degree", range(5))
def test_harmonics_are_the_recorded_ones(units: Any, backend: Backend, degree: int) -> None:
    """A splat per direction, seen from the origin."""
    file = units("unit_sh")
    dirs, coeffs = leaves(*backend.put((file["dirs"].reshape(200, 3), file["coeffs"].repeat(2, 1, 1))))
    everything = torch.ones(1, 200, dtype=torch.bool, device=backend.device)
    colors = ops.harmonics(dirs, dirs.new_zeros(1, 3), coeffs, degree, everything)[0].view(2, 100, 4)
    assert_close(colors, file[f"f64_out{degree}"], ROUNDING)
    v_dirs, v_coeffs = torch.autograd.grad((colors * backend.put(file["w"])).sum(), [dirs, coeffs])
    want = [file[f"f64_v_dirs{degree}"], file[f"f64_v_coeffs{degree}"]]
    assert_close([v_dirs.view(2, 100, 3), v_coeffs.view(2, 100, 25, 4).sum(0)], want, ROUNDING)


# Pictures


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", ["tiny", "basic"])
def test_images_of_gsplat_on_cuda(shared: Path, name: str, dtype: torch.dtype) -> None:
    """Asked for: 5e-6. Measured 1.3e-6 (tiny) and 6.5e-7 (basic) in float64, which is their float32; alpha was clamped to
    0.999.
    """
    with numpy.load(shared / "data" / "gsplat_reference_images" / f"{name}_case.npz") as file:
        data = {k: torch.from_numpy(file[k]).to(dtype) for k in file.files}
    viewmat, K = torch.eye(4, dtype=dtype), torch.tensor([[61.5, 0.0, 61.5], [0.0, 61.5, 41.0], [0.0, 0.0, 1.0]], dtype=dtype)
    viewmat[:3, 3] = -torch.tensor([0.123, 0.456, -8.0], dtype=dtype)
    r = rasterize(data["means"], data["quats"], data["scales"].exp(), data["opacities"].sigmoid(), data["coeffs"],
                  Camera(viewmat, K, 123, 82), sh_degree=3, alpha_max=0.999)
    assert (torch.cat([r.image, r.alpha[..., None]], -1) - data["out_img"]).abs().max() <= 2e-6


@pytest.mark.parametrize(("file", "eye", "covered"), [("inria_train_first1000", (4.0, -0.5, 4.0), 0.1),
                                                      ("playbot_lod3_31k", (1.5, -1.2, 1.8), 0.3),
                                                      ("massa", (0.3, -0.7, 2.8), 0.2)])
def test_trained_scenes_render(shared: Path, file: str, eye: tuple[float, ...], covered: float) -> None:
    """Finite, something to see, the same with any tile size, and the splats that show most as `plain` has them."""
    scene = Gaussians.load(shared / "data" / "splats" / f"{file}.ply")
    cam = Camera.look_at(eye, scene.means.median(0).values.tolist(), width=48, height=36)
    with torch.no_grad():
        splats = [scene.means, scene.quats, scene.scales, scene.opacities, scene.sh]
        r = rasterize(*splats, cam, sh_degree=scene.sh_degree, depth="expected")
        assert all(x.isfinite().all() for x in r[:3])
        assert 0 <= r.alpha.min()
        assert r.alpha.max() <= 1
        assert r.alpha.mean() > covered
        assert r.image.std() > 0.02
        # float32: a polynomial about another tile centre rounds otherwise, by eps times its terms of up to some hundred
        assert_close(rasterize(*splats, cam, sh_degree=scene.sh_degree, tile=16).image, r.image, 1e-4)
        large = (r.meta.radii[0].min(-1).values).topk(200).indices
        some = [x[large].double() for x in splats]
        cam = cam.to(torch.float64)
        want = plain.render(*some, cam.viewmats[None], cam.Ks[None], 48, 36, sh_degree=scene.sh_degree)
        assert_close(rasterize(*some, cam, sh_degree=scene.sh_degree)[:2], [x[0] for x in want[:2]], 1e-12)
