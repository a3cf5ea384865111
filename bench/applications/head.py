"""A head from photos (Pulsar, section 5.1, Figure 4c): a random volume, pruned, refined into 12 spheres each, optimised again.

    python bench/applications/head.py

50 views of a bust over a blue background, which none of its colours is near to, and 10 held out. Prints the number of spheres and the held-out PSNR
after each stage. The picture: the spheres in four of the held-out views.
"""

from __future__ import annotations

from pathlib import Path

import torch
from common import PSNR, ROOT, Stage, Views, arguments, load_views, report, write_rows
from reconstruction import FINE_GAMMA, Result, reconstruct

CENTRE = 0.04, -1.05, 0.0
RADIUS = 1.5                # of a ball around what the views show
DISTANCE = 3.0
BACKGROUND = 0.1, 0.3, 0.9


def stage_of_head(channels: int = 3) -> Stage:
    """The ball that the head is in. Channels beyond the colours have no background."""
    return Stage(torch.tensor(CENTRE), RADIUS, DISTANCE, torch.tensor(BACKGROUND + (0.0,) * (channels - 3)), fade_below=0.5)


def load(data: Path, downscale: float) -> tuple[Views, Views]:
    """Training and held-out views."""
    return load_views(data / "massa_head_views", downscale, torch.tensor(BACKGROUND))


def main(argv: list[str] | None = None) -> Result:
    """Reconstruct, print and draw."""
    parser = arguments(__doc__, "head", steps=200, batch=1, volume=4000, refinements=2, downscale=2.0, reach=1.0)
    parser.add_argument("--spheres", type=Path, default=ROOT / "out" / "head.ply", help="a file for the spheres (default: out/head.ply)")
    args = parser.parse_args(argv)
    generator = torch.Generator().manual_seed(args.seed)
    with report(args, PSNR) as document:
        stage, (train, test) = stage_of_head(), load(args.data, args.downscale)
        result = reconstruct(stage, train, test, volume=args.volume, refinements=args.refinements, steps=args.steps, batch=args.batch,
                             reach=args.reach, generator=generator, say=lambda line: print(f"head, {line}", flush=True))
        args.spheres.parent.mkdir(parents=True, exist_ok=True)
        result.spheres.save(args.spheres)
        some = test[torch.tensor([0, 3, 6, 9])]
        with torch.no_grad():
            images = [stage.render(result.spheres, camera, FINE_GAMMA[1]) for camera, _ in some.each()]
        write_rows(args.picture, [images], some.images if args.targets else None)
        document |= {**result.document(), "spheres": len(result.spheres), "steps": args.steps * (args.refinements + 1)}
    return result


if __name__ == "__main__":
    main()
