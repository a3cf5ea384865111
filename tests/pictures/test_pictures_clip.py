"""GIFs and MP4s, read back."""

import resource
import struct
import sys
import weakref
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tsplat.pictures import write_clip
from tsplat.pictures.gif import LEVELS, _lzw, write_gif

COLORS = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [0.5, 0.5, 0.5], [0.2, 0.7, 0.4]])


def unlzw(data: bytes) -> list[int]:
    """GIF's LZW with 8-bit symbols, as a reader does it."""
    bits, width, out, position = int.from_bytes(data, "little"), 9, [], 0
    table: list[list[int]] = []
    previous: list[int] = []
    while True:
        code = bits >> position & (1 << width) - 1
        position += width
        if code == 257:
            return out
        if code == 256:
            table, width, previous = [[i] for i in range(256)] + [[], []], 9, []
            continue
        entry = table[code] if code < len(table) else [*previous, previous[0]]
        if previous and len(table) < 4096:
            table.append([*previous, entry[0]])
        width = 12 if len(table) >= 2048 else max(9, len(table).bit_length())
        out += entry
        previous = entry


@settings(max_examples=20, deadline=None)
@given(n=st.integers(1, 20_000), colors=st.integers(1, 252), seed=st.integers(0, 99))
def test_lzw_is_read_back(n: int, colors: int, seed: int) -> None:
    """From a few pixels to more than a table of codes holds."""
    pixels = torch.randint(0, colors, (n,), generator=torch.Generator().manual_seed(seed)).to(torch.uint8).numpy()
    assert unlzw(_lzw(pixels)) == pixels.tolist()


def test_gif(tmp_path: Path) -> None:
    frames = [torch.full((6, 10, 3), level) for level in (0.0, 1.0)]
    write_gif(tmp_path / "a.gif", frames, fps=25)
    data = (tmp_path / "a.gif").read_bytes()
    assert data[:6] == b"GIF89a"
    assert struct.unpack("<HH", data[6:10]) == (10, 6)
    assert data.endswith(b"\x00\x3B")
    assert data.count(b"\x21\xF9\x04") == 2                          # frames
    assert data[data.index(b"\x21\xF9\x04") + 4] == 4                # hundredths of a second
    palette = data[13:13 + 768]
    first = data.index(b"\x2C\x00\x00\x00\x00")
    size = data[first + 11]
    assert unlzw(data[first + 12:first + 12 + size]) == [0] * 60
    assert palette[:3] == b"\x00\x00\x00"
    assert palette[3 * 251:3 * 252] == b"\xff\xff\xff"
    assert LEVELS[0] * LEVELS[1] * LEVELS[2] == 252


@pytest.mark.parametrize(("name", "frames", "message"), [
    ("a.png", [torch.zeros(2, 2, 3)], r"a\.png: expected a file name that ends in \.gif"), ("a.gif", [], "^frames: expected at least 1 frame"),
    ("a.gif", [torch.zeros(2, 2, 3), torch.zeros(3, 2, 3)], r"^frames: expected shape \[2, 2, 3\]; got \[3, 2, 3\]"),
    ("a.gif", [torch.zeros(0, 2, 3)], "^frames: expected 1 to 65535 pixels a side; got 2x0"),
])
def test_gif_of_bad_frames(tmp_path: Path, name: str, frames: list[torch.Tensor], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        write_gif(tmp_path / name, frames)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["a.gif", "a.mp4"])
def test_frames_are_not_held(tmp_path: Path, name: str) -> None:
    """At most the one that is written, and the first, which tells the size, while the next is made."""
    if name.endswith("mp4"):
        pytest.importorskip("imageio_ffmpeg", reason="an MP4 needs imageio-ffmpeg: pip install 'tsplat[video]'")
    alive: list[weakref.ref[Tensor]] = []
    most = 0

    def frames() -> Iterator[Tensor]:
        nonlocal most
        for i in range(8):
            frame = torch.full((8, 8, 3), i / 8)
            alive.append(weakref.ref(frame))
            yield frame
            del frame
            most = max(most, sum(ref() is not None for ref in alive))

    write_clip(tmp_path / name, frames())
    assert most <= 2


@pytest.mark.parametrize("name", ["a.gif", "a.mp4"])
def test_an_older_clip_stays_until_the_new_one_is_whole(tmp_path: Path, name: str) -> None:
    if name.endswith("mp4"):
        pytest.importorskip("imageio_ffmpeg", reason="an MP4 needs imageio-ffmpeg: pip install 'tsplat[video]'")
    (tmp_path / name).write_text("old")

    def broken() -> Iterator[Tensor]:
        yield torch.zeros(8, 8, 3)
        raise ArithmeticError("the renderer failed")

    with pytest.raises(ArithmeticError):
        write_clip(tmp_path / name, broken())
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4000, limits[1]))              # as where the disk is full
    try:
        with pytest.raises(OSError):
            write_clip(tmp_path / name, (torch.rand(64, 64, 3) for _ in range(4)))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "old"


def test_another_reader_of_gifs(tmp_path: Path) -> None:
    """ffmpeg's; the means of dithered pixels are right to a twelfth of a step between two colours, 1/6 to 1/5 apart."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="an MP4 needs imageio-ffmpeg: pip install 'tsplat[video]'")
    write_clip(tmp_path / "a.gif", (color.expand(32, 48, 3) for color in COLORS), fps=20)
    reader = ffmpeg.read_frames(str(tmp_path / "a.gif"))
    about = next(reader)
    assert (about["size"], about["fps"]) == ((48, 32), 20)
    frames = [torch.frombuffer(bytearray(data), dtype=torch.uint8).view(32, 48, 3).float() / 255 for data in reader]
    assert len(frames) == len(COLORS)
    for frame, color in zip(frames, COLORS, strict=True):
        torch.testing.assert_close(frame.mean((0, 1)), color, atol=1 / 60, rtol=0)


def test_mp4(tmp_path: Path) -> None:
    """H.264, yuv420p, an even size; colours as a player decodes them, to the steps of 8 bits of brightness and colour."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="an MP4 needs imageio-ffmpeg: pip install 'tsplat[video]'")
    path = tmp_path / "a: fähre" / "clip one.mp4"
    path.parent.mkdir()
    write_clip(path, (color.expand(33, 47, 3) for color in COLORS), fps=12.5)
    assert [p.name for p in path.parent.iterdir()] == ["clip one.mp4"]
    reader = ffmpeg.read_frames(f"file:{path}")
    about = next(reader)
    assert about["codec"] == "h264"
    assert about["pix_fmt"].startswith("yuv420p")
    assert about["size"] == (46, 32)
    assert about["fps"] == 12.5
    frames = [torch.frombuffer(bytearray(data), dtype=torch.uint8).view(32, 46, 3).float() / 255 for data in reader]
    assert len(frames) == len(COLORS)
    for frame, color in zip(frames, COLORS, strict=True):           # half a step of Y (0.6/255) and of Cb or Cr (1.1), and of 8 bits in and out
        torch.testing.assert_close(frame, color.expand(32, 46, 3), atol=3 / 255, rtol=0)


@pytest.mark.parametrize(("frames", "fps", "message"), [
    ([], 25.0, "^frames: expected at least 1 frame; got none"), ([torch.zeros(4, 4, 3)], 0.0, "^fps: expected above 0"),
    ([torch.zeros(1, 4, 3)], 25.0, "^frames: expected at least 2x2 pixels in an MP4; got 4x1"),
    ([torch.zeros(4, 4, 3), torch.zeros(4, 6, 3)], 25.0, r"^frames: expected shape \[4, 4, 3\]; got \[4, 6, 3\]"),
])
def test_mp4_of_bad_frames(tmp_path: Path, frames: list[Tensor], fps: float, message: str) -> None:
    pytest.importorskip("imageio_ffmpeg", reason="an MP4 needs imageio-ffmpeg: pip install 'tsplat[video]'")
    with pytest.raises(ValueError, match=message):
        write_clip(tmp_path / "a.mp4", frames, fps)
    assert not list(tmp_path.iterdir())


def test_other_names_and_a_missing_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match=r"a\.avi: expected a file name that ends in \.gif or \.mp4; got '\.avi'"):
        write_clip(tmp_path / "a.avi", [])
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ImportError, match=r"a\.mp4: an MP4 needs the package imageio-ffmpeg: pip install 'tsplat\[video\]'"):
        write_clip(tmp_path / "a.mp4", [torch.zeros(4, 4, 3)])
    write_clip(tmp_path / "a.GIF", [torch.zeros(4, 4, 3)])
