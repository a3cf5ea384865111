"""Every op with small arguments, and the whole renderer, for the tests of what torch expects of an operator."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

import scenes
import torch
import tsplat_reference as reference
from backends import Backend
from compare import leaves
from torch import Tensor

import tsplat
from tsplat import Camera, ops

WIDTH, HEIGHT, TILE = 7, 6, 4 if not torch.cuda.is_available() else 8
# the package has functions of these names
projection, frustum, harmonics, binning, blending, spheres = (importlib.import_module(f"tsplat.ops.{name}") for name in (
    "projection", "frustum", "harmonics", "binning", "blending", "spheres"))


def project_arguments(antialiased: bool = True, covars: bool = False, n: int = 6) -> tuple[Any, ...]:
    s, cam = scenes.splats(n, seed=1), scenes.camera(2, WIDTH, HEIGHT)
    shape = (None, None, reference.covariances(s.quats, s.scales)) if covars else (s.quats, s.scales, None)
    return (s.means, *shape, s.opacities, cam.viewmats, cam.Ks, WIDTH, HEIGHT, "pinhole", 0.01, 1e10, 0.3, antialiased)


def may_see_arguments(n: int = 6) -> tuple[Any, ...]:
    s, cam = scenes.splats(n, seed=1), scenes.camera(2, WIDTH, HEIGHT)
    return s.means, s.scales.amax(1), s.opacities, cam.viewmats, cam.Ks, WIDTH, HEIGHT, "pinhole", 0.01, 1e10, 0.3


def harmonics_arguments(degree: int = 2, n: int = 6) -> tuple[Any, ...]:
    g = scenes.generator(0)
    mask = torch.ones(2, n, dtype=torch.bool)
    mask[0, 1:2] = False
    return scenes.normal(n, 3, seed=g), scenes.normal(2, 3, seed=g), scenes.sh_coefficients(n, degree), degree, mask


def splats2d(n: int = 6) -> scenes.Splats2D:
    return scenes.splats2d(2, n, WIDTH, HEIGHT, seed=3, size=(0.8, 3.0))


def bin_arguments(n: int = 6) -> tuple[Any, ...]:
    s = splats2d(n)
    return s.means2d, s.radii, s.conics, s.opacities, s.depths, WIDTH, HEIGHT, TILE


def blend_arguments(n: int = 6, background: bool = True, absgrad: bool = True, shared_colors: bool = False, drop_last: bool = False
                    ) -> tuple[Any, ...]:
    s = splats2d(n)
    colors = s.colors[:1] if shared_colors else s.colors
    bins = reference.bin_splats(*bin_arguments(n))
    return (s.means2d, s.conics, s.opacities, colors, s.backgrounds if background else None,
            torch.zeros_like(s.means2d) if absgrad else None, *bins, WIDTH, HEIGHT, TILE, 0.99, drop_last)


def project_backward_arguments(antialiased: bool = True, covars: bool = False, n: int = 6, cameras: bool = True, sparse: bool = False
                               ) -> tuple[Any, ...]:
    args = project_arguments(antialiased, covars, n)
    radii, *outputs = reference.project(*args)
    v_means2d, v_depths, v_conics, v_compensations = (torch.randn_like(x) for x in outputs)
    return *args, radii, v_means2d, None if sparse else v_depths, v_conics, None if sparse else v_compensations, cameras


def harmonics_backward_arguments(degree: int = 2, n: int = 6, cameras: bool = True) -> tuple[Any, ...]:
    args = harmonics_arguments(degree, n)
    return *args, torch.randn_like(reference.harmonics(*args)), cameras


def blend_backward_arguments(n: int = 6, background: bool = True, absgrad: bool = True,
                             shared_colors: bool = False) -> tuple[Any, ...]:
    args = blend_arguments(n, background, absgrad, shared_colors)
    image, alphas = reference.blend(*args[:5], *args[6:])
    return (*args[:5], *args[6:8], image, alphas, torch.randn_like(image), torch.randn_like(alphas), *args[8:], absgrad)


def outline_arguments(n: int = 6, model: str = "pinhole") -> tuple[Any, ...]:
    s, cam = scenes.spheres(n, seed=1, spread=0.4), scenes.camera(2, WIDTH, HEIGHT, model=model)
    centers = torch.einsum("cij,nj->cni", cam.viewmats[:, :3, :3], s.positions) + cam.viewmats[:, None, :3, 3]
    return centers, s.radii[None], cam.Ks, WIDTH, HEIGHT, model, 0.5, 8.0


def sphere_bins(*args: Any) -> tuple[Tensor, Tensor]:
    o = reference.outlines(*args)
    return reference.bin_splats(o.means2d, o.radii, o.conics, o.opacities, o.depths, WIDTH, HEIGHT, TILE)


def nearest_arguments(n: int = 6) -> tuple[Any, ...]:
    centers, radii, Ks, *options = outline_arguments(n)
    return centers, radii, Ks, *sphere_bins(centers, radii, Ks, *options), 3, WIDTH, HEIGHT, TILE, "pinhole", 0.5, 8.0, False


def sphere_arguments(n: int = 6, model: str = "pinhole", chord: bool = False, depth: bool = True, cut: bool = False) -> tuple[Any, ...]:
    centers, radii, Ks, *_ = args = outline_arguments(n, model)
    s = scenes.spheres(n, seed=1)
    return (centers, radii, s.opacities[None], s.features[None], torch.rand(2, 3, dtype=torch.float64),
            torch.tensor(0.2, dtype=torch.float64), Ks, *sphere_bins(*args),
            torch.full((2, HEIGHT, WIDTH), 4.0, dtype=torch.float64) if cut else None, WIDTH, HEIGHT, TILE, model, 0.5, 8.0, 0.1, chord, depth, 0.0)


def sphere_backward_arguments(intrinsics: bool = True, depth: bool = True, **others: Any) -> tuple[Any, ...]:
    args = sphere_arguments(depth=depth, **others)
    images = reference.blend_spheres(*args[:-1])
    v_image, v_depth, v_logsumexp = (torch.randn_like(x) for x in images[:3])
    return *args[:10], *images, v_image, v_depth if depth else None, v_logsumexp if depth else None, *args[10:18], intrinsics


CASES: dict[str, tuple[Any, Callable[..., tuple[Any, ...]], dict[str, Any]]] = {
    "project": (projection.project_op, project_arguments, {}),
    "project, covars": (projection.project_op, project_arguments, {"covars": True, "antialiased": False}),
    "project, N = 0": (projection.project_op, project_arguments, {"n": 0}),
    "project_backward": (projection.project_backward_op, project_backward_arguments, {}),
    "project_backward, covars": (projection.project_backward_op, project_backward_arguments,
                                 {"covars": True, "antialiased": False}),
    "project_backward, N = 0": (projection.project_backward_op, project_backward_arguments, {"n": 0}),
    "project_backward, fixed cameras": (projection.project_backward_op, project_backward_arguments, {"cameras": False}),
    "project_backward, sparse": (projection.project_backward_op, project_backward_arguments, {"sparse": True}),
    "may_see": (frustum.may_see_op, may_see_arguments, {}),
    "may_see, N = 0": (frustum.may_see_op, may_see_arguments, {"n": 0}),
    "harmonics": (harmonics.harmonics_op, harmonics_arguments, {}),
    "harmonics, degree 0": (harmonics.harmonics_op, harmonics_arguments, {"degree": 0}),
    "harmonics, N = 0": (harmonics.harmonics_op, harmonics_arguments, {"n": 0}),
    "harmonics_backward": (harmonics.harmonics_backward_op, harmonics_backward_arguments, {}),
    "harmonics_backward, degree 0": (harmonics.harmonics_backward_op, harmonics_backward_arguments, {"degree": 0}),
    "harmonics_backward, N = 0": (harmonics.harmonics_backward_op, harmonics_backward_arguments, {"n": 0}),
    "harmonics_backward, fixed cameras": (harmonics.harmonics_backward_op, harmonics_backward_arguments, {"cameras": False}),
    "bin_splats": (binning.bin_splats_op, bin_arguments, {}),
    "bin_splats, N = 0": (binning.bin_splats_op, bin_arguments, {"n": 0}),
    "bin_splats_fixed": (binning.bin_splats_fixed_op, lambda: (*bin_arguments(), 40), {}),
    "bin_splats_fixed, too few": (binning.bin_splats_fixed_op, lambda: (*bin_arguments(), 3), {}),
    "blend": (blending.blend_op, blend_arguments, {}),
    "blend, bare": (blending.blend_op, blend_arguments, {"background": False, "absgrad": False, "shared_colors": True}),
    "blend, drop_last": (blending.blend_op, blend_arguments, {"drop_last": True}),
    "blend, N = 0": (blending.blend_op, blend_arguments, {"n": 0}),
    "blend_backward": (blending.blend_backward_op, blend_backward_arguments, {}),
    "blend_backward, bare": (blending.blend_backward_op, blend_backward_arguments,
                             {"background": False, "absgrad": False, "shared_colors": True}),
    "blend_backward, N = 0": (blending.blend_backward_op, blend_backward_arguments, {"n": 0}),
    "outlines": (spheres.outlines_op, outline_arguments, {}),
    "outlines, N = 0": (spheres.outlines_op, outline_arguments, {"n": 0}),
    "nearest_hits": (spheres.nearest_hits_op, nearest_arguments, {}),
    "nearest_hits, N = 0": (spheres.nearest_hits_op, nearest_arguments, {"n": 0}),
    "blend_spheres": (spheres.blend_spheres_op, sphere_arguments, {}),
    "blend_spheres, orthographic": (spheres.blend_spheres_op, sphere_arguments, {"model": "orthographic", "depth": False}),
    "blend_spheres, chord": (spheres.blend_spheres_op, sphere_arguments, {"chord": True}),
    "blend_spheres, N = 0": (spheres.blend_spheres_op, sphere_arguments, {"n": 0}),
    "blend_spheres_backward": (spheres.blend_spheres_backward_op, sphere_backward_arguments, {}),
    "blend_spheres_backward, bare": (spheres.blend_spheres_backward_op, sphere_backward_arguments, {"depth": False, "intrinsics": False}),
    "blend_spheres_backward, cut": (spheres.blend_spheres_backward_op, sphere_backward_arguments, {"cut": True}),
    "blend_spheres_backward, N = 0": (spheres.blend_spheres_backward_op, sphere_backward_arguments, {"n": 0}),
}
FORWARD = [name for name in CASES if "backward" not in name]
NO_GRADIENT = ("bin", "may_see", "outlines", "nearest")


def case(name: str, backend: Backend) -> tuple[Any, list[Any]]:
    op, make, options = CASES[name]
    return op, list(backend.put(make(**options)))


def require_grad(args: list[Any], but: tuple[int, ...] = ()) -> list[Any]:
    return [a.requires_grad_() if isinstance(a, Tensor) and a.is_floating_point() and i not in but else a for i,
            a in enumerate(args)]


def differentiable_case(name: str, backend: Backend) -> tuple[Callable[..., Any], list[Tensor]]:
    """The public function of a case, of its differentiable arguments only, and these."""
    _, make, options = CASES[name]
    args = backend.put(make(**({"n": 3} | options)))
    stage = name.split(",")[0]
    which = {"project": (0, 1, 2, 3, 5, 6), "harmonics": (0, 1, 2), "blend": (0, 1, 2, 3, 4), "blend_spheres": range(7)}[stage]
    which = [i for i in which if args[i] is not None]
    inputs = leaves(*(args[i] for i in which))
    function = getattr(ops, stage)

    def call(*tensors: Tensor) -> list[Tensor]:
        mine = list(args)
        for i, tensor in zip(which, tensors, strict=True):
            mine[i] = (tensor + tensor.mT) / 2 if i == 3 and stage == "project" else tensor     # covariances are symmetric
        results = function(*mine)
        return [r for r in ([results] if isinstance(results, Tensor) else results) if r.is_floating_point() and r.requires_grad]

    return call, inputs


WITH_GRADIENT = [name for name in FORWARD if not name.startswith(NO_GRADIENT)]
DIFFERENTIABLE = [name for name in WITH_GRADIENT if "N = 0" not in name]


def render(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor, viewmats: Tensor, Ks: Tensor,
           background: Tensor, offset: Tensor, width: int = WIDTH, height: int = HEIGHT) -> tuple[Tensor, Tensor, Tensor]:
    """All stages and options at once."""
    r = tsplat.rasterize(means, quats, scales, opacities, sh, Camera(viewmats, Ks, width, height), sh_degree=1,
                         background=background, depth="expected", antialiased=True, screen_offset=offset)
    return r.image, r.alpha, r.depth


def render_arguments(backend: Backend, n: int = 6, width: int = WIDTH, height: int = HEIGHT) -> list[Tensor]:
    s, cam = scenes.splats(n, seed=2, size=(0.2, 0.6), spread=0.8), scenes.camera(2, width, height)
    return leaves(*backend.put((*s[:4], scenes.sh_coefficients(n, 1), cam.viewmats, cam.Ks, torch.tensor([0.1, 0.2, 0.3]),
                                torch.zeros(2, n, 2))))
