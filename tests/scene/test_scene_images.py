"""Image files and the store: alpha, masks, sizes, the bound on memory, broken files."""

import struct
import zlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch
from kornia_rs import io as codecs
from torch import Tensor

from tsplat.scene import ImageStore, Photo, read_image, write_image
from tsplat.scene.image_files import image_size
from tsplat.scene.images import load_photo

Ramp = Callable[..., Tensor]


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_round_trip(tmp_path: Path, channels: int) -> None:
    image = torch.rand(7, 5, channels)
    write_image(tmp_path / "a.png", image)
    assert image_size(tmp_path / "a.png") == (5, 7)
    read = read_image(tmp_path / "a.png")
    assert read.dtype == torch.uint8
    assert read.shape == (7, 5, max(channels, 3))
    assert ((read / 255 - image).abs() <= 0.5 / 255 + 1e-6).all()


def test_out_of_range_is_clamped(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", torch.tensor([[[-1.0, 2.0, torch.nan], [torch.inf, -torch.inf, 0.5]]]))
    assert read_image(tmp_path / "a.png").tolist() == [[[0, 255, 0], [255, 0, 128]]]


def test_write_refuses(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"image: expected \[H, W, 1\]"):
        write_image(tmp_path / "a.png", torch.zeros(4, 4, 2))
    with pytest.raises(TypeError, match="image: expected a floating-point"):
        write_image(tmp_path / "a.png", torch.zeros(4, 4, 3, dtype=torch.uint8))
    with pytest.raises(ValueError, match=r"ends in \.png"):
        write_image(tmp_path / "a.jpg", torch.zeros(4, 4, 3))
    with pytest.raises(FileNotFoundError, match="folder"):
        write_image(tmp_path / "no" / "a.png", torch.zeros(4, 4, 3))
    assert not list(tmp_path.iterdir())


def test_other_files(tmp_path: Path, ramp: Ramp) -> None:
    pixels = (ramp(20, 12) * 255).to(torch.uint8).numpy()
    codecs.write_image_jpeg(str(tmp_path / "a.jpg"), pixels, "rgb", 95)
    codecs.write_image_jpeg(str(tmp_path / "grey.jpg"), pixels[..., :1].copy(), "mono", 95)
    codecs.write_image_tiff_u8(str(tmp_path / "a.tif"), pixels, "rgb")
    codecs.write_image_png_u16(str(tmp_path / "deep.png"), pixels.astype("uint16") * 257, "rgb")
    for name in ("a.jpg", "grey.jpg", "a.tif", "deep.png"):
        assert image_size(tmp_path / name) == (20, 12)
        assert read_image(tmp_path / name).shape == (12, 20, 3)
    padded = (tmp_path / "a.jpg").read_bytes()
    (tmp_path / "padded.jpg").write_bytes(padded[:2] + b"\xff\xff" + padded[2:])      # fill bytes before a marker
    assert image_size(tmp_path / "padded.jpg") == (20, 12)
    codecs.write_image_tiff_f32(str(tmp_path / "float.tif"), ramp(20, 12).numpy(), "rgb")
    with pytest.raises(ValueError, match=r"float\.tif: expected"):
        read_image(tmp_path / "float.tif")
    for name in ("a.tif", "deep.png"):
        assert torch.equal(read_image(tmp_path / name), torch.from_numpy(pixels))
    # it changes along x alone; of a block, quality 95 rounds the cosines to steps of 2, 1, 1, 2, 2, 4, 5 and 6: by 2 at most, and whole numbers by 1
    assert abs(read_image(tmp_path / "grey.jpg").numpy().astype(int) - pixels[..., :1]).max() <= 3


GREY, RGB, INDEXED, GREY_ALPHA, RGBA = 0, 2, 3, 4, 6                # colour types of PNG


def png(width: int, depth: int, kind: int, pixels: bytes, **chunks: bytes) -> bytes:
    """A file of one row, with chunks before it."""
    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    every = {"IHDR": struct.pack(">IIBBBBB", width, 1, depth, kind, 0, 0, 0), **chunks, "IDAT": zlib.compress(b"\0" + pixels), "IEND": b""}
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(name.encode(), body) for name, body in every.items())


COLORS = bytes((10, 20, 30, 40, 50, 60, 70, 80, 90))
A, B = (10, 20, 30), (70, 80, 90)


@pytest.mark.parametrize(("file", "pixels"), [
    (png(2, 8, INDEXED, b"\0\2", PLTE=COLORS), [A, B]),
    (png(2, 8, INDEXED, b"\0\2", tEXt=b"a\0b", PLTE=COLORS, tRNS=b"\x07"), [(*A, 7), (*B, 255)]),
    (png(2, 8, GREY, b"\x0a\x14", tRNS=b"\0\x0a"), [(10, 10, 10, 0), (20, 20, 20, 255)]),
    (png(2, 8, RGB, bytes(A + B), tRNS=bytes((0, 70, 0, 80, 0, 90))), [(*A, 255), (*B, 0)]),
    (png(2, 8, RGB, bytes(A + B), tRNS=bytes((0, 70, 0, 80, 0, 91))), [(*A, 255), (*B, 255)]),
    (png(2, 8, RGB, bytes(A + B), PLTE=COLORS), [A, B]),
    (png(2, 8, GREY, b"\0\2", PLTE=COLORS), [(0, 0, 0), (2, 2, 2)]),
    (png(2, 8, RGBA, bytes((*A, 1, *B, 2)), tRNS=bytes(8)), [(*A, 1), (*B, 2)]),
    (png(2, 16, GREY, bytes((10, 10, 20, 20)), tRNS=bytes((20, 20))), [(10, 10, 10, 255), (20, 20, 20, 0)]),
    (png(2, 16, GREY, bytes((10, 10, 20, 20)), tRNS=bytes((20, 21))), [(10, 10, 10, 255), (20, 20, 20, 255)])],
    ids=["palette", "palette with alpha", "grey key", "RGB key", "another key", "a suggested palette", "a palette of greys",
         "a key beside alpha", "deep key", "another deep key"])
def test_palettes_and_transparent_colours(tmp_path: Path, file: bytes, pixels: list[tuple[int, ...]]) -> None:
    (tmp_path / "a.png").write_bytes(file)
    assert read_image(tmp_path / "a.png").tolist() == [[list(p) for p in pixels]]


@pytest.mark.parametrize("file", [
    png(8, 1, GREY, b"\xaa"), png(2, 8, GREY_ALPHA, bytes(4)), png(2, 8, INDEXED, b"\0\0", PLTE=COLORS[:4]),
    png(2, 8, INDEXED, b"\0\3", PLTE=COLORS), png(2, 8, INDEXED, b"\0\2", PLTE=COLORS, tRNS=bytes(4))],
    ids=["one bit", "grey and alpha", "half a colour", "no such colour", "too many alphas"])
def test_a_png_that_cannot_be_read(tmp_path: Path, file: bytes) -> None:
    (tmp_path / "a.png").write_bytes(file)
    with pytest.raises(ValueError, match=r"a\.png: expected an image that can be decoded; \w"):
        read_image(tmp_path / "a.png")


def test_not_an_image(tmp_path: Path) -> None:
    write_image(tmp_path / "whole.png", torch.rand(40, 40, 3))
    whole = (tmp_path / "whole.png").read_bytes()
    codecs.write_image_jpeg(str(tmp_path / "whole.jpg"), torch.randint(256, (80, 80, 3), dtype=torch.uint8).numpy(), "rgb", 95)
    photo = (tmp_path / "whole.jpg").read_bytes()
    contents = {"a.png": b"no image", "a.jpg": b"no image", "empty.jpg": b"", "a.xyz": b"no image",
                "cut.jpg": b"\xff\xd8\xff\xe0\x00\x04ab", "cut.png": whole[:len(whole) // 2], "half.jpg": photo[:len(photo) // 2],
                "spoilt.jpg": photo[:len(photo) // 2] + bytes(200) + photo[len(photo) // 2 + 200:],
                "huge.png": whole[:33] + b"\xff\xff\xff\xffPLTEabc"}
    for name, content in contents.items():
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(ValueError, match=name):
            read_image(path)
        if name not in ("cut.png", "half.jpg", "spoilt.jpg", "huge.png"):          # whose sizes are there
            with pytest.raises(ValueError, match=name):
                image_size(path)
        with pytest.raises(ValueError, match=name):
            ImageStore([Photo(path, 4, 4)])[0]
    with pytest.raises(FileNotFoundError):
        read_image(tmp_path / "absent.png")
    with pytest.raises(IsADirectoryError):
        read_image(tmp_path)


@pytest.mark.parametrize("factor", [1, 2, 3, 1.5, 4])
def test_reduction_averages(tmp_path: Path, factor: float) -> None:
    width, height = round(24 / factor), round(12 / factor)
    image = torch.rand(12, 24, 3)
    write_image(tmp_path / "a.png", image)
    reduced = load_photo(Photo(tmp_path / "a.png", width, height)) / 255
    assert reduced.shape == (height, width, 3)
    assert (reduced.mean((0, 1)) - image.mean((0, 1))).abs().max() < 0.02
    if factor in (2, 3, 4):
        k = int(factor)
        expected = image.view(height, k, width, k, 3).mean((1, 3))
        assert (reduced - expected).abs().max() < 1.01 / 255


def test_reduction_weights_by_alpha(tmp_path: Path) -> None:
    image = torch.zeros(2, 4, 4)
    image[:, 0] = torch.tensor([1.0, 0.5, 0.25, 1.0])               # the left of the first block is opaque,
    image[:, 1] = torch.tensor([0.0, 1.0, 0.0, 0.0])                # its right transparent, in another colour
    write_image(tmp_path / "a.png", image)
    reduced = load_photo(Photo(tmp_path / "a.png", 2, 1)) / 255
    torch.testing.assert_close(reduced[0, 0], torch.tensor([1.0, 0.5, 0.25, 0.5]), atol=2 / 255, rtol=0)
    assert reduced[0, 1].tolist() == [0, 0, 0, 0]


def test_mask(tmp_path: Path, ramp: Ramp) -> None:
    write_image(tmp_path / "a.png", ramp(8, 4))
    mask = torch.zeros(8, 16, 1)
    mask[:, 8:] = 1
    write_image(tmp_path / "mask.png", mask)                        # of twice the size
    image = ImageStore([Photo(tmp_path / "a.png", 8, 4, mask=tmp_path / "mask.png")])[0]
    assert image.shape == (4, 8, 4)
    assert image[:, :4, 3].eq(0).all()
    assert image[:, 4:, 3].eq(1).all()
    assert (image[..., :3] - ramp(8, 4)).abs().max() < 1 / 255      # colours under the mask stay
    write_image(tmp_path / "b.png", torch.cat([ramp(8, 4), torch.full((4, 8, 1), 0.6)], dim=2))
    both = ImageStore([Photo(tmp_path / "b.png", 8, 4, mask=tmp_path / "mask.png")])[0]
    torch.testing.assert_close(both[..., 3], image[..., 3] * 0.6)


def test_store_keeps_within_its_bound(tmp_path: Path, ramp: Ramp, monkeypatch: pytest.MonkeyPatch) -> None:
    photos = []
    for i in range(6):
        write_image(tmp_path / f"{i}.png", ramp(10, 8, phase=float(i)))
        photos.append(Photo(tmp_path / f"{i}.png", 10, 8))
    decoded: list[str] = []

    def load(photo: Photo) -> Tensor:
        decoded.append(photo.path.stem)
        return load_photo(photo)

    monkeypatch.setattr("tsplat.scene.images.load_photo", load)
    size = 10 * 8 * 3
    store = ImageStore(photos, cache_bytes=3 * size + size // 2)
    assert len(store) == 6
    for i in (0, 1, 2, 0, 3, 0, 2, 1):                              # 3 takes the place of 1, then 1 that of 3
        image = store[i]
        assert image.dtype == torch.float32
        assert (image - ramp(10, 8, phase=float(i))).abs().max() < 1 / 255
        assert store.held_bytes <= 3 * size
    assert decoded == ["0", "1", "2", "3", "1"]
    image = store[1]
    image.zero_()                                                   # a caller's changes do not reach the cache
    assert store[1].any()
    assert torch.equal(store[-1], store[5])
    with pytest.raises(IndexError):
        store[6]

    decoded.clear()
    small = ImageStore(photos, cache_bytes=size - 1)
    for _ in range(2):
        assert small[0].shape == (8, 10, 3)
    assert decoded == ["0", "0"]
    assert small.held_bytes == 0
    with pytest.raises(ValueError, match="cache_bytes"):
        ImageStore(photos, cache_bytes=-1)


def test_store_keeps_within_its_bound_for_several_threads(tmp_path: Path) -> None:
    photos = []
    for i in range(4):
        write_image(tmp_path / f"{i}.png", torch.full((6, 8, 3), i / 255))
        photos.append(Photo(tmp_path / f"{i}.png", 8, 6))
    store = ImageStore(photos, cache_bytes=2 * 6 * 8 * 3)
    with ThreadPoolExecutor(4) as pool:
        values = list(pool.map(lambda i: round(255 * float(store[i % 4].mean())), range(200)))
    assert values == [i % 4 for i in range(200)]
    assert store.held_bytes == 2 * 6 * 8 * 3
