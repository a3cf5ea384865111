"""Photos that do not fit in memory: what a capture of 1,000 photos of 4K takes, as a fit streams it.

    python bench/photos.py                           # 1,000 photos of 3840x2160, about 5 minutes

Some different JPEG files are drawn (noise of all scales, 1.3 MB each), and a capture in a temporary folder has links to them for photos. They
are read as the trainer reads them: in random order, the next by the worker thread while one is used, which is to make of it what a step compares
with. Nothing is rendered. A row for each mark gives the photos so far, the peak of the process's memory, and photos per second of wall and of CPU
time, which other work on the machine changes less. At the first mark the cache of decoded photos (`tsplat.scene.images.CACHE_BYTES`) has filled up,
and from there on memory should not grow.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from output import add_json, environment, peak_memory, print_json, printing
from torch import Tensor
from torch.nn.functional import interpolate

from tsplat.fit.losses import target_of
from tsplat.fit.stream import PhotoStream
from tsplat.scene import Capture, load_capture
from tsplat.scene.images import CACHE_BYTES

SIZE = 3840, 2160
FILES = 4
MARKS = 100, 300, 1000


def noise(width: int, height: int, generator: torch.Generator) -> Tensor:
    """`[3, height, width]` uint8: as much detail at each scale from 4 pixels on, as photos have it."""
    image = torch.zeros(3, height, width)
    scale = 4
    while scale < width:
        small = torch.rand(1, 3, height // scale + 2, width // scale + 2, generator=generator)
        image += interpolate(small, size=(height, width), mode="bilinear")[0] - 0.5
        scale *= 2
    return (255 * (image / 4 + 0.5).clamp(0, 1)).to(torch.uint8)


def make_capture(folder: Path, photos: int, size: tuple[int, int]) -> Path:
    """Write a transforms.json, files of that size, and as many links to them as there are `photos`."""
    from kornia_rs.io import write_image_jpeg

    (folder / "images").mkdir()
    generator = torch.Generator().manual_seed(0)
    for i in range(FILES):
        write_image_jpeg(str(folder / f"{i}.jpg"), noise(*size, generator).permute(1, 2, 0).contiguous().numpy(), "rgb", 80)
    frames = []
    for i in range(photos):
        name = f"images/{i:04d}.jpg"
        (folder / name).symlink_to(folder / f"{i % FILES}.jpg")
        frames.append({"file_path": name, "transform_matrix": torch.eye(4).tolist()})
    path = folder / "transforms.json"
    path.write_text(json.dumps({"w": size[0], "h": size[1], "fl_x": size[0], "frames": frames}), encoding="utf-8")
    return path


def stream(capture: Capture, marks: list[int]) -> list[dict[str, Any]]:
    """A row for each of the marks, up to the last."""
    order = torch.randperm(len(capture), generator=torch.Generator().manual_seed(0)).tolist()
    rows, wall, cpu = [], time.perf_counter(), time.process_time()
    with PhotoStream(capture.images) as images:
        for done, view in enumerate(order, 1):
            photo = images[view]
            if done < len(order):
                images.prepare(order[done])
            target = target_of(photo, torch.zeros(3), masked=False)
            assert target.image.shape == (capture.height[view], capture.width[view], 3)
            if done in marks:
                rows.append({"streamed": done, "peak_MiB": peak_mib(), "photos_per_s": done / (time.perf_counter() - wall),
                             "photos_per_cpu_s": done / (time.process_time() - cpu)})
                print("| {streamed:,} | {peak_MiB:,.0f} | {photos_per_s:.1f} | {photos_per_cpu_s:.1f} |".format(**rows[-1]), flush=True)
    return rows


def peak_mib() -> float:
    """Of the memory of this process so far."""
    return peak_memory() / 2**20


def measure_all(marks: list[int], size: tuple[int, int]) -> dict[str, Any]:
    """The table."""
    with tempfile.TemporaryDirectory() as folder:
        capture = load_capture(make_capture(Path(folder), max(marks), size), test_every=0)
        decoded = 3 * size[0] * size[1] / 2**20
        print(f"{size[0]}x{size[1]}, {decoded:.1f} MiB each when decoded, {decoded * max(marks) / 1024:.1f} GiB in all; "
              f"{CACHE_BYTES / 2**30:g} GiB of them are kept; {peak_mib():.0f} MiB before the first\n")
        print("| photos | peak MiB | photos/s | photos/CPU s |\n" + "| --- " * 4 + "|")
        before = peak_mib()
        rows = stream(capture, marks)
    return {**environment("cpu"), "width": size[0], "height": size[1], "cache_MiB": CACHE_BYTES / 2**20, "all_MiB": decoded * max(marks),
            "before_MiB": before, "rows": rows}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=int, nargs="+", default=list(MARKS), help="after so many of them a row is printed; the last is of all")
    parser.add_argument("--size", type=int, nargs=2, default=SIZE, metavar=("WIDTH", "HEIGHT"))
    add_json(parser)
    args = parser.parse_args()
    with printing(args.json):
        results = measure_all(sorted(args.photos), (args.size[0], args.size[1]))
    if args.json:
        print_json(results)


if __name__ == "__main__":
    main()
