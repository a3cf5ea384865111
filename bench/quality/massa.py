"""Quality of views that were rendered from splats, so that a scene can show them exactly: massa at 256x256, 50 views, 10 held out.

Use: `python bench/quality/massa.py [--data FOLDER] [--seeds 0 1 2] [--steps 2000]`.
"""

from common import measure

from tsplat.fit import FitConfig

if __name__ == "__main__":
    measure("massa_head_views", __doc__, FitConfig(steps=2000, splats=20_000), (1 / 4, 1 / 2))
