"""A training loop as one writes it for gsplat, by its documentation. The tests run it with the import line changed, and nothing else."""

import torch
from gsplat import DefaultStrategy, rasterization


def train(images, viewmats, Ks, points, colors, steps):
    """Fit Gaussians at points `[N, 3]` to images `[V, H, W, 3]`; the losses, and how many Gaussians there are at the end."""
    device, n = points.device, len(points)
    params = torch.nn.ParameterDict({
        "means": torch.nn.Parameter(points),
        "scales": torch.nn.Parameter(torch.full((n, 3), -3.5, device=device)),
        "quats": torch.nn.Parameter(torch.rand(n, 4, device=device)),
        "opacities": torch.nn.Parameter(torch.logit(torch.full((n,), 0.2, device=device))),
        "sh0": torch.nn.Parameter((colors[:, None] - 0.5) / 0.28209479177387814),
        "shN": torch.nn.Parameter(torch.zeros(n, 3, 3, device=device)),
    })
    rates = {"means": 1e-3, "scales": 2e-2, "quats": 1e-3, "opacities": 5e-2, "sh0": 1e-2, "shN": 5e-4}
    optimizers = {name: torch.optim.Adam([{"params": params[name], "lr": rate, "name": name}], eps=1e-15) for name, rate in rates.items()}
    strategy = DefaultStrategy(refine_start_iter=50, refine_every=50, refine_stop_iter=120, reset_every=1000)
    strategy.check_sanity(params, optimizers)
    strategy_state = strategy.initialize_state(scene_scale=1.0)

    losses = []
    height, width = images.shape[1:3]
    for step in range(steps):
        view = step * 7 % len(images)
        renders, alphas, info = rasterization(
            means=params["means"],
            quats=params["quats"],
            scales=torch.exp(params["scales"]),
            opacities=torch.sigmoid(params["opacities"]),
            colors=torch.cat([params["sh0"], params["shN"]], 1),
            viewmats=viewmats[view][None],
            Ks=Ks[view][None],
            width=width,
            height=height,
            sh_degree=min(step // 100, 1),
            packed=False,
            render_mode="RGB+ED",
        )
        strategy.step_pre_backward(params, optimizers, strategy_state, step, info)
        loss = torch.nn.functional.l1_loss(renders[0, ..., :3], images[view])
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        strategy.step_post_backward(params, optimizers, strategy_state, step, info, packed=False)
        losses.append(loss.item())
    return losses, len(params["means"])
