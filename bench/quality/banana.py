"""A fit of few and wide views under the whole adaptive control, which must not blow up: banana at 375x249, 13 photos, 2 held out.

Use: `python bench/quality/banana.py [--data FOLDER] [--seeds 0 1 2] [--steps 1500]`.
"""

from common import measure

from tsplat.fit import FitConfig

if __name__ == "__main__":
    measure("banana", __doc__, FitConfig(steps=1500, splats=10_000, downscale=4, density="adaptive", max_splats=60_000))
