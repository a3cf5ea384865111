"""`tsplat compare`."""

from __future__ import annotations

import argparse
from pathlib import Path

from tsplat.cli.common import add_json, print_json, print_qualities
from tsplat.fit.comparison import ERROR_GAIN, compare
from tsplat.fit.output import metrics_of

HELP = "measure how like images are, and show where they differ"
USAGE = "tsplat compare A B [options]"
DESCRIPTION = f"""
PSNR (at most 100 dB) and SSIM of two images, or of those of the same names in
two folders. The folder of a fit stands for its renders in test/, without the
photos beside them. A picture shows A, B and {ERROR_GAIN:g} times their difference.
"""
EXAMPLES = """
  tsplat compare photo.png render.png -o difference.png
  tsplat compare out other_out -o differences
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("a", type=Path, metavar="A", help="an image, a folder of images, or the folder of a fit")
    parser.add_argument("b", type=Path, metavar="B", help="one of the same kind")
    parser.add_argument("-o", "--out", type=Path, metavar="OUT", help="picture to write, .png; of two folders, the folder for pictures. It is made")
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    qualities = compare(options.a, options.b, options.out)
    if options.json:
        print_json(metrics_of(qualities))
        return
    print_qualities(qualities, "pairs" if len(qualities) > 1 else "pair")
    if options.out is not None:
        print(f"{options.out}: A, B, and their difference, of which {1 / ERROR_GAIN:.2f} is white")
