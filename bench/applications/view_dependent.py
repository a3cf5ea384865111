"""View-dependent shading (Pulsar, section 5.2, Figure 5c): a small network of each pixel's features and viewing direction.

    python bench/applications/view_dependent.py

The chair of the NeRF paper at 100x100 over a blue background: 100 views, and 13 held out. A random volume is reconstructed as in `head.py`.
From there, plain colours go on, and, for as many steps, colours with five features more, to which a fully connected network, the same for
all pixels, adds what it makes of features and viewing direction; both by squared error. Prints the held-out PSNR of both. The picture, in held-out
views: plain colours, the network's.
"""

from __future__ import annotations

import torch
from common import PSNR, Spheres, Stage, Views, arguments, load_views, mean_psnr, optimise, report, write_rows
from reconstruction import reconstruct
from torch import Tensor, nn

import tsplat

FEATURES = 8
WIDTH = 32
RADIUS, DISTANCE = 1.5, 4.03
BACKGROUND = 0.1, 0.3, 0.9
GAMMA = 3e-3
SPEED = 0.3
"""Of the geometry: at full learning rates the last steps lost 0.4 dB."""


def directions(camera: tsplat.Camera) -> Tensor:
    """Unit viewing directions in the world `[(C,) H, W, 3]`."""
    x, y = torch.arange(camera.width) + 0.5, torch.arange(camera.height) + 0.5
    pixels = torch.stack([*torch.meshgrid(x, y, indexing="xy"), torch.ones(camera.height, camera.width)], -1)
    to_world = torch.linalg.inv(camera.Ks).mT @ camera.viewmats[..., :3, :3]                # rows of pixels to rows of rays
    return torch.nn.functional.normalize(pixels @ to_world[..., None, :, :], dim=-1)


class Shader(nn.Module):
    """The first three channels of an image plus what a perceptron makes of all and of the direction, pixel by pixel; at first zero."""

    def __init__(self, channels: int, width: int = WIDTH) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(channels + 3, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, 3))
        nn.init.zeros_(self.layers[-1].weight)
        nn.init.zeros_(self.layers[-1].bias)

    def forward(self, image: Tensor, camera: tsplat.Camera) -> Tensor:
        """Colours `[(C,) H, W, 3]`."""
        return image[..., :3] + self.layers(torch.cat([image, directions(camera)], -1))


class Plain(nn.Module):
    """The image itself."""

    def forward(self, image: Tensor, camera: tsplat.Camera) -> Tensor:
        """Colours `[(C,) H, W, 3]`."""
        return image


def main(argv: list[str] | None = None) -> tuple[float, float]:
    """Reconstruct, go on in both ways, print and draw."""
    parser = arguments(__doc__, "view_dependent", steps=250, batch=1, volume=4000, refinements=2, downscale=4.0, reach=1.0)
    args = parser.parse_args(argv)
    generator = torch.Generator().manual_seed(args.seed)
    with report(args, PSNR) as document:
        torch.manual_seed(args.seed)                                                            # of the network's weights
        background = torch.tensor(BACKGROUND)
        train, test = load_views(args.data / "nerf_synthetic_chair", args.downscale, background)

        def stage_of(channels: int) -> Stage:
            return Stage(torch.zeros(3), RADIUS, DISTANCE, torch.cat([background, torch.zeros(channels - 3)]), fade_below=0.5)

        result = reconstruct(stage_of(3), train, test, volume=args.volume, refinements=args.refinements, steps=args.steps, batch=args.batch,
                             reach=args.reach, generator=generator, say=lambda line: print(f"chair, {line}", flush=True))
        geometry = result.spheres

        def fit(shader: nn.Module, channels: int) -> tuple[Stage, Spheres, float]:
            stage = stage_of(channels)
            extra = 0.1 * torch.randn(len(geometry), channels - 3, generator=generator)
            spheres = geometry.with_features(torch.cat([geometry.features.detach(), extra], 1))
            groups = [*spheres.groups(RADIUS / 4, SPEED), {"params": list(shader.parameters()), "lr": 5e-3}]
            batches = torch.Generator().manual_seed(args.seed)                                  # the same for both

            def loss(some: Views, gamma: float) -> Tensor:
                return (shader(stage.render(spheres, some.cameras, gamma), some.cameras) - some.images).square().mean()

            optimise([group for group in groups if group["params"]], train, loss, steps=args.steps, batch=args.batch, gamma=(GAMMA, GAMMA),
                     generator=batches, name=type(shader).__name__)
            return stage, spheres, mean_psnr(lambda camera: shader(stage.render(spheres, camera, GAMMA), camera), test)

        shaders = Plain(), Shader(FEATURES)
        results = [fit(shader, channels) for shader, channels in zip(shaders, (3, FEATURES), strict=True)]
        without, with_ = (quality for _, _, quality in results)
        print(f"view-dependent shading: {len(geometry)} spheres, held-out PSNR {without:.2f} dB with plain colours, {with_:.2f} dB with a network of "
              "the viewing direction")
        found = result.document()
        found["figures"] |= {"plain colours, on": without, "with the network": with_}
        document |= {**found, "spheres": len(geometry), "steps": args.steps * (args.refinements + 3),
                     "note": f"the last two from the same geometry by as many steps, at gamma {GAMMA:g}; those before by L1, at gammas of their own"}
        some = test[torch.arange(0, len(test), 3)[:5]]
        with torch.no_grad():
            rows = [[shader(stage.render(spheres, camera, GAMMA), camera) for camera, _ in some.each()]
                    for shader, (stage, spheres, _) in zip(shaders, results, strict=True)]
        write_rows(args.picture, rows, some.images if args.targets else None)
    return without, with_


if __name__ == "__main__":
    main()
