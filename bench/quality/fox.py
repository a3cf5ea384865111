"""Held-out quality of a short fit of real photos on a CPU: fox at 133x237, 43 photos to train on, 7 held out, 27,000 splats.

Use: `python bench/quality/fox.py [--data FOLDER] [--seeds 0 1 2] [--steps 1000] [--splats 12000 --max-splats 43000] [--resolution-warmup 0.6]`.
"""

from common import measure

from tsplat.fit import FitConfig

if __name__ == "__main__":
    measure("fox", __doc__, FitConfig(steps=1000, splats=27_000, downscale=4))
