"""Clips: frames as an animated GIF, which takes no library, or as an MP4, by ffmpeg."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from torch import Tensor

from tsplat.pictures.gif import sized, write_gif
from tsplat.scene.files import replacing
from tsplat.scene.image_files import to_bytes

FPS = 25.0                  # 4 hundredths of a second, in which a GIF counts
CLIPS = (".gif", ".mp4")
H264 = {"codec": "libx264", "pix_fmt_out": "yuv420p", "quality": None, "macro_block_size": 2}
BT709 = ["-vf", "scale=out_color_matrix=bt709", "-colorspace", "bt709"]
"""The colours that players assume; without it, ffmpeg converts to those of standard definition, and greens and reds shift."""
OUTPUT = [*BT709, "-crf", "18", "-movflags", "+faststart"]      # CRF 18: hardly to be told from the frames; shown while it is still loading


def write_clip(path: str | os.PathLike[str], frames: Iterable[Tensor], fps: float = FPS) -> None:
    """Write a clip in the format of its name. Frames are taken one at a time, and an older file stays until the new one is whole.

    A GIF is endless, of 252 fixed colours with dithering. An MP4 is H.264, yuv420p, which needs even sizes: an odd last column or row
    is left out.

    Args:
        path: ends in `.gif` or `.mp4`; its folder exists.
        frames: at least one, all `[H, W, 3]` in 0..1 (clamped) and of one size.
        fps: frames per second.

    Raises:
        ValueError, TypeError: naming the argument.
        ImportError: an MP4, without the package imageio-ffmpeg.
        OSError: the file cannot be written.
    """
    path = Path(path)
    check_clip(path)
    if path.suffix.lower() == ".gif":
        write_gif(path, frames, fps)
    else:
        _write_mp4(path, frames, fps)


def check_clip(path: Path) -> None:
    """Raise what `write_clip` raises about the name of the file and what it takes, before there are frames."""
    if path.suffix.lower() not in CLIPS:
        raise ValueError(f"{path}: expected a file name that ends in {' or '.join(CLIPS)}; got {path.suffix!r}")
    if path.suffix.lower() == ".mp4":
        try:
            import imageio_ffmpeg  # noqa: F401
        except ImportError as error:
            raise ImportError(f"{path}: an MP4 needs the package imageio-ffmpeg: pip install 'tsplat[video]' ({error}); "
                              "a .gif needs nothing") from None


def _write_mp4(path: Path, frames: Iterable[Tensor], fps: float) -> None:
    from imageio_ffmpeg import read_frames, write_frames

    if not 0 < fps <= 1000:
        raise ValueError(f"fps: expected above 0 and up to 1000 frames per second; got {fps}")
    rows, columns, frames = sized(frames)
    height, width = rows // 2 * 2, columns // 2 * 2
    if not min(height, width):
        raise ValueError(f"frames: expected at least 2x2 pixels in an MP4; got {columns}x{rows}")
    with replacing(path) as temporary:
        name = f"file:{temporary}"                     # lest ffmpeg take what is before a colon for a protocol
        writer = write_frames(name, (width, height), fps=fps, ffmpeg_log_level="fatal", output_params=list(OUTPUT), **H264)
        writer.send(None)
        try:
            for frame in frames:
                pixels = to_bytes(frame[:height, :width]).contiguous().numpy()
                try:
                    writer.send(pixels)
                except OSError:                        # with pages of text
                    raise OSError(f"{path}: cannot be written; ffmpeg gave up (is the disk full?)") from None
        finally:
            writer.close()
        try:
            next(read_frames(name))                    # that ffmpeg failed in the end, it does not tell: can its index be read?
        except (OSError, RuntimeError):
            raise OSError(f"{path}: cannot be written; ffmpeg gave up (is the disk full?)") from None
