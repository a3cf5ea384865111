"""A training loop in the style of 3D Gaussian Splatting's own code. The tests run it with the import line changed, and nothing else."""

import math

import torch
from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer


class Gaussians:
    """The parameters and what density control sums up."""

    def __init__(self, points, colors):
        n, device = len(points), points.device
        self._xyz = torch.nn.Parameter(points)
        self._features_dc = torch.nn.Parameter((colors[:, None] - 0.5) / 0.28209479177387814)
        self._features_rest = torch.nn.Parameter(torch.zeros(n, 3, 3, device=device))
        self._scaling = torch.nn.Parameter(torch.full((n, 3), -3.5, device=device))
        self._rotation = torch.nn.Parameter(torch.rand(n, 4, device=device))
        self._opacity = torch.nn.Parameter(torch.logit(torch.full((n, 1), 0.2, device=device)))
        self.max_radii2D = torch.zeros(n, device=device)
        self.xyz_gradient_accum, self.denom = torch.zeros(n, 1, device=device), torch.zeros(n, 1, device=device)
        rates = {"_xyz": 1e-3, "_features_dc": 1e-2, "_features_rest": 5e-4, "_scaling": 2e-2, "_rotation": 1e-3, "_opacity": 5e-2}
        self.optimizer = torch.optim.Adam([{"params": [getattr(self, k)], "lr": v, "name": k} for k, v in rates.items()], lr=0.0, eps=1e-15)

    def add_densification_stats(self, viewspace_point_tensor, update_filter):
        """The gradient in the image, in units of half its size."""
        self.xyz_gradient_accum[update_filter] += torch.norm(viewspace_point_tensor.grad[update_filter, :2], dim=-1, keepdim=True)
        self.denom[update_filter] += 1


class Camera:
    """Transposed matrices, for row vectors."""

    def __init__(self, viewmat, K, width, height, znear=0.01, zfar=100.0):
        self.image_width, self.image_height = width, height
        self.FoVx, self.FoVy = (2 * math.atan(size / (2 * f.item())) for size, f in ((width, K[0, 0]), (height, K[1, 1])))
        P = torch.zeros(4, 4, device=K.device)
        P[0, 0], P[1, 1] = 1 / math.tan(self.FoVx / 2), 1 / math.tan(self.FoVy / 2)
        P[0, 2], P[1, 2] = 2 * K[0, 2] / width - 1, 2 * K[1, 2] / height - 1
        P[3, 2], P[2, 2], P[2, 3] = 1.0, zfar / (zfar - znear), -(zfar * znear) / (zfar - znear)
        self.world_view_transform = viewmat.transpose(0, 1)
        self.full_proj_transform = self.world_view_transform.unsqueeze(0).bmm(P.transpose(0, 1).unsqueeze(0)).squeeze(0)
        self.camera_center = self.world_view_transform.inverse()[3, :3]


def render(camera, pc, bg_color, active_sh_degree):
    """Image, points in the image whose gradient will be kept, which are visible, radii, and inverse depths."""
    screenspace_points = torch.zeros_like(pc._xyz, dtype=pc._xyz.dtype, requires_grad=True, device=pc._xyz.device) + 0
    screenspace_points.retain_grad()
    raster_settings = GaussianRasterizationSettings(
        image_height=int(camera.image_height),
        image_width=int(camera.image_width),
        tanfovx=math.tan(camera.FoVx * 0.5),
        tanfovy=math.tan(camera.FoVy * 0.5),
        bg=bg_color,
        scale_modifier=1.0,
        viewmatrix=camera.world_view_transform,
        projmatrix=camera.full_proj_transform,
        sh_degree=active_sh_degree,
        campos=camera.camera_center,
        prefiltered=False,
        debug=False,
        antialiasing=False,
    )
    rasterizer = GaussianRasterizer(raster_settings=raster_settings)
    rendered_image, radii, depth_image = rasterizer(
        means3D=pc._xyz,
        means2D=screenspace_points,
        shs=torch.cat((pc._features_dc, pc._features_rest), dim=1),
        colors_precomp=None,
        opacities=torch.sigmoid(pc._opacity),
        scales=torch.exp(pc._scaling),
        rotations=torch.nn.functional.normalize(pc._rotation),
        cov3D_precomp=None,
    )
    return rendered_image, screenspace_points, (radii > 0).nonzero(), radii, depth_image


def train(images, viewmats, Ks, points, colors, steps):
    """Fit Gaussians at points `[N, 3]` to images `[V, H, W, 3]`; the losses, and how many Gaussians have been seen."""
    gaussians, losses = Gaussians(points, colors), []
    background = torch.zeros(3, device=points.device)
    height, width = images.shape[1:3]
    cameras = [Camera(viewmat, K, width, height) for viewmat, K in zip(viewmats, Ks)]  # noqa: B905
    for iteration in range(1, steps + 1):
        view = iteration * 7 % len(images)
        image, viewspace_point_tensor, visibility_filter, radii, _ = render(cameras[view], gaussians, background, min(iteration // 100, 1))
        loss = torch.abs(image - images[view].permute(2, 0, 1)).mean()
        loss.backward()
        losses.append(loss.item())
        with torch.no_grad():
            gaussians.max_radii2D[visibility_filter] = torch.max(gaussians.max_radii2D[visibility_filter], radii[visibility_filter])
            gaussians.add_densification_stats(viewspace_point_tensor, visibility_filter)
            gaussians.optimizer.step()
            gaussians.optimizer.zero_grad(set_to_none=True)
    return losses, int((gaussians.denom > 0).sum())
