"""Quality over time of NeRF-synthetic chair at 200x200 on a CPU: random start, white background, 20,000 splats, 100 views, 13 held out.

Use: `python bench/quality/chair.py [--data FOLDER] [--seeds 0 1 2] [--steps 3000]`.
"""

from common import measure

from tsplat.fit import FitConfig

if __name__ == "__main__":
    measure("nerf_synthetic_chair", __doc__, FitConfig(steps=3000, splats=20_000, downscale=2, background="white"), (1 / 8, 1 / 4, 1 / 2))
