"""Neural shading (Pulsar, section 5.1, Figure 4d and e): 15 feature channels of the head's spheres, decoded by a small convolutional network.

    python bench/applications/neural_shading.py

The geometry is that of `head.py`, of which the result is read, or made if it is not there yet, and it stays. The first three channels start as the
colours, and the network adds to them what it makes of all channels, at first nothing. The loss is the squared error; by L1 the network gained
nothing over the colours (the paper has L1 with a perceptual and an adversarial loss). Prints the held-out PSNR of the head's colours, with the
gamma that `head.py` ends with, which is the figure that it ends with, too; of these after as many steps more as the network gets, with this gamma
and with the network's, which is softer; and of the network. Each fit sees the same views in the same order. The picture, in held-out views: plain
colours after their steps, with the gamma of `head.py`; the network's; and three of the other channels.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import head
import torch
from common import PSNR, ROOT, Spheres, Stage, Views, arguments, mean_psnr, optimise, report, write_rows
from output import printing
from reconstruction import FINE_GAMMA
from torch import Tensor, nn

import tsplat

CHANNELS = 15
WIDTH = 32
GAMMA = 1e-2
"""Softer than what `head.py` ends with: colours gain half a dB by that alone, which is why they are fitted with both."""


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


@dataclass(frozen=True)
class Shading:
    """Spheres, and what makes colours of their features' images."""

    stage: Stage
    spheres: Spheres
    gamma: float
    decoder: nn.Module

    def features(self, camera: tsplat.Camera) -> Tensor:
        """`[(C,) H, W, D]`."""
        return self.stage.render(self.spheres, camera, self.gamma)

    def draw(self, camera: tsplat.Camera) -> Tensor:
        """Colours `[(C,) H, W, 3]`."""
        colors: Tensor = self.decoder(self.features(camera))
        return colors


def main(argv: list[str] | None = None) -> dict[str, float]:
    """Optimise the colours, then features and network, print and draw. Returns the figures."""
    parser = arguments(__doc__, "neural_shading", steps=150, batch=1, downscale=2.0)
    parser.add_argument("--spheres", type=Path, default=ROOT / "out" / "head.ply", help="what head.py wrote (default: out/head.ply)")
    args = parser.parse_args(argv)
    if not args.spheres.is_file():
        with printing(args.json):
            head.main(["--data", str(args.data), "--spheres", str(args.spheres), "--seed", str(args.seed)])
    with report(args, PSNR) as document:
        torch.manual_seed(args.seed)                                                        # of the network's weights
        spheres = Spheres.load(args.spheres)
        for parameter in (spheres.positions, spheres.log_radii, spheres.opacity_logits):
            parameter.requires_grad_(False)
        train, test = head.load(args.data, args.downscale)

        def fit(decoder: nn.Module, channels: int, gamma: float) -> Shading:
            stage = head.stage_of_head(channels)
            extra = 0.1 * torch.randn(len(spheres), channels - 3, generator=torch.Generator().manual_seed(args.seed))
            shading = Shading(stage, spheres.with_features(torch.cat([spheres.features.detach(), extra], 1)), gamma, decoder)
            groups = [{"params": [shading.spheres.features], "lr": 2e-2}, {"params": list(decoder.parameters()), "lr": 3e-3}]

            def loss(some: Views, gamma: float) -> Tensor:
                return (shading.draw(some.cameras) - some.images).square().mean()

            optimise([group for group in groups if group["params"]], train, loss, steps=args.steps, batch=args.batch, gamma=(gamma, gamma),
                     generator=torch.Generator().manual_seed(args.seed), name=f"{channels} channels")         # the same views for all fits
            return shading

        plain = nn.Identity()
        shadings = {"the head's colours": Shading(head.stage_of_head(), spheres, FINE_GAMMA[1], plain),
                    "colours, on": fit(plain, 3, FINE_GAMMA[1]), "colours, on, softer": fit(plain, 3, GAMMA),
                    "network": fit(Decoder(CHANNELS), CHANNELS, GAMMA)}
        figures = {name: mean_psnr(shading.draw, test) for name, shading in shadings.items()}
        for name, shading in shadings.items():
            print(f"neural shading, {name}: {len(spheres)} spheres, gamma {shading.gamma:g}, held-out PSNR {figures[name]:.2f} dB")
        some, (colors, network) = test[torch.tensor([0, 3, 6, 9])], (shadings["colours, on"], shadings["network"])
        with torch.no_grad():
            features = [network.features(camera) for camera, _ in some.each()]
            rows = [colors.draw(camera) for camera, _ in some.each()], map(network.decoder, features), (x[..., 3:6] + 0.5 for x in features)
            write_rows(args.picture, rows, some.images if args.targets else None)
        document |= {"figures": figures, "spheres": len(spheres), "steps": 3 * args.steps,
                     "note": f"the first is that of head.py; the first two at its gamma, {FINE_GAMMA[1]:g}, the others at {GAMMA:g}; the colours go "
                             "on by squared error, for as many steps and with the same views as the network"}
    return figures


if __name__ == "__main__":
    main()
