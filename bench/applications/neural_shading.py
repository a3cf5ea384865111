"""Neural shading (Pulsar, section 5.1, Figure 4d and e): 15 feature channels of the head's spheres, decoded by a small convolutional network.

    python bench/applications/neural_shading.py

The geometry is that of `head.py`, of which the result is read, or made if it is not there yet, and it stays. The first three channels start as the
colours, and the network adds to them what it makes of all channels, at first nothing. The loss is the
squared error, by which the network gained 0.9 dB over the colours; by L1 it gained nothing (the paper has L1 with a perceptual and an adversarial
loss). Prints the held-out PSNR of the head's colours, of these after as many steps more, and of the network. The picture, in held-out views: plain
colours, the network's, and three of the other channels.
"""

from __future__ import annotations

import time
from pathlib import Path

import head
import torch
from common import ROOT, Spheres, Stage, Views, arguments, mean_psnr, optimise, report, write_rows
from torch import Tensor, nn

import tsplat

CHANNELS = 15
WIDTH = 32
GAMMA = 1e-2
"""Softer than what `head.py` ends with, which was 0.3 dB worse."""


class Decoder(nn.Module):
    """The first three channels of an image `[..., H, W, D]` plus what three convolutions make of all, at first zero."""

    def __init__(self, channels: int, width: int = WIDTH) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Conv2d(channels, width, 3, padding=1), nn.ReLU(), nn.Conv2d(width, width, 3, padding=1), nn.ReLU(),
                                    nn.Conv2d(width, 3, 3, padding=1))
        nn.init.zeros_(self.layers[-1].weight)
        nn.init.zeros_(self.layers[-1].bias)

    def forward(self, image: Tensor) -> Tensor:
        """Colours `[..., H, W, 3]`."""
        planes = image.movedim(-1, -3)
        return image[..., :3] + self.layers(planes).movedim(-3, -1)


def main(argv: list[str] | None = None) -> tuple[float, float, float]:
    """Optimise the colours, then features and network, print and draw."""
    parser = arguments(__doc__, "neural_shading.png", steps=150, batch=1, downscale=2.0)
    parser.add_argument("--spheres", type=Path, default=ROOT / "out" / "head.ply", help="what head.py wrote (default: out/head.ply)")
    args = parser.parse_args(argv)
    if not args.spheres.is_file():
        head.main(["--data", str(args.data), "--spheres", str(args.spheres), "--seed", str(args.seed)])
    start, generator = time.process_time(), torch.Generator().manual_seed(args.seed)
    torch.manual_seed(args.seed)                                                            # of the network's weights
    spheres = Spheres.load(args.spheres)
    for parameter in (spheres.positions, spheres.log_radii, spheres.opacity_logits):
        parameter.requires_grad_(False)
    train, test = head.load(args.data, args.downscale)

    def fit(decoder: nn.Module, channels: int) -> tuple[Stage, Spheres]:
        stage = head.stage_of_head(channels)
        extra = 0.1 * torch.randn(len(spheres), channels - 3, generator=generator)
        featured = spheres.with_features(torch.cat([spheres.features.detach(), extra], 1))
        groups = [{"params": [featured.features], "lr": 2e-2}, {"params": list(decoder.parameters()), "lr": 3e-3}]

        def loss(some: Views, gamma: float) -> Tensor:
            return (decoder(stage.render(featured, some.cameras, gamma)) - some.images).square().mean()

        optimise([group for group in groups if group["params"]], train, loss, steps=args.steps, batch=args.batch, gamma=(GAMMA, GAMMA),
                 generator=generator, name=f"{channels} channels")
        return stage, featured

    def quality(decoder: nn.Module, stage: Stage, some: Spheres) -> float:
        def draw(camera: tsplat.Camera) -> Tensor:
            colors: Tensor = decoder(stage.render(some, camera, GAMMA))
            return colors

        return mean_psnr(draw, test)

    plain, network = nn.Identity(), Decoder(CHANNELS)
    before = quality(plain, head.stage_of_head(), spheres)
    colors, features = fit(plain, 3), fit(network, CHANNELS)
    longer, after = quality(plain, *colors), quality(network, *features)
    print(f"neural shading: {len(spheres)} spheres, held-out PSNR of the head's colours {before:.2f} dB, after {args.steps} steps more "
          f"{longer:.2f} dB, of {CHANNELS} channels and a network {after:.2f} dB")
    with torch.no_grad():
        some = test[torch.tensor([0, 3, 6, 9])]
        images = [(colors[0].render(colors[1], camera, GAMMA), features[0].render(features[1], camera, GAMMA)) for camera, _ in some.each()]
        rows = [a for a, _ in images], [network(b) for _, b in images], [b[..., 3:6] + 0.5 for _, b in images]
        write_rows(args.picture, rows, some.images if args.targets else None)
    report(start, args.picture)
    return before, longer, after


if __name__ == "__main__":
    main()
