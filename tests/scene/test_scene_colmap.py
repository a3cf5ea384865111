"""COLMAP models: every camera model in both encodings, broken files, real models."""

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tsplat.scene import Lens, read_colmap
from tsplat.scene.colmap import MODEL_NAMES, MODEL_PARAMS

PARAMS = {
    "SIMPLE_PINHOLE": (50.0, 32.0, 24.0),
    "PINHOLE": (50.0, 51.0, 32.0, 24.0),
    "SIMPLE_RADIAL": (50.0, 32.0, 24.0, 0.01),
    "RADIAL": (50.0, 32.0, 24.0, 0.01, -0.02),
    "OPENCV": (50.0, 51.0, 32.0, 24.0, 0.01, -0.02, 0.001, 0.002),
    "OPENCV_FISHEYE": (50.0, 51.0, 32.0, 24.0, 0.01, -0.02, 0.03, 0.04),
    "FULL_OPENCV": (50.0, 51.0, 32.0, 24.0, 0.01, -0.02, 0.001, 0.002, 0.03, 0.04, 0.05, 0.06),
}
LENSES = {
    "SIMPLE_PINHOLE": Lens(64, 48, 50, 50, 32, 24),
    "PINHOLE": Lens(64, 48, 50, 51, 32, 24),
    "SIMPLE_RADIAL": Lens(64, 48, 50, 50, 32, 24, (0.01, 0, 0, 0, 0, 0, 0, 0)),
    "RADIAL": Lens(64, 48, 50, 50, 32, 24, (0.01, -0.02, 0, 0, 0, 0, 0, 0)),
    "OPENCV": Lens(64, 48, 50, 51, 32, 24, (0.01, -0.02, 0.001, 0.002, 0, 0, 0, 0)),
    "OPENCV_FISHEYE": Lens(64, 48, 50, 51, 32, 24, (0.01, -0.02, 0.03, 0.04), fisheye=True),
    "FULL_OPENCV": Lens(64, 48, 50, 51, 32, 24, (0.01, -0.02, 0.001, 0.002, 0.03, 0.04, 0.05, 0.06)),
}
POSES = {"b c.jpg": (0.5, 0.5, 0.5, 0.5, 1.0, 2.0, 3.0), "a.jpg": (2.0, 0.0, 0.0, 0.0, -1.0, 0.5, 0.25)}
POINTS = [((0.5, 1.0, -2.0), (255, 0, 51), 3), ((3.0, 4.0, 5.0), (0, 255, 0), 0), ((7.0, 8.0, 9.0), (1, 2, 3), 1)]


def write_txt(folder: Path, model: str) -> None:
    folder.mkdir(exist_ok=True)
    (folder / "cameras.txt").write_text(f"# cameras\n4 {model} 64 48 {' '.join(map(str, PARAMS[model]))}\n")
    (folder / "images.txt").write_text("# images\n" + "".join(
        f"{i} {' '.join(map(str, pose))} 4 {name}\n{'1.5 2.5 -1 3.5 4.5 2' if i else ''}\n"
        for i, (name, pose) in enumerate(POSES.items())))
    (folder / "points3D.txt").write_text("# points\n" + "".join(
        f"{i} {' '.join(map(str, (*xyz, *rgb)))} 0.5 {'1 2 ' * track}\n" for i, (xyz, rgb, track) in enumerate(POINTS)))


def write_bin(folder: Path, model: str) -> None:
    folder.mkdir(exist_ok=True)
    params = PARAMS[model]
    cameras = struct.pack(f"<QiiQQ{len(params)}d", 1, 4, MODEL_NAMES.index(model), 64, 48, *params)
    images = struct.pack("<Q", len(POSES))
    for i, (name, pose) in enumerate(POSES.items()):
        images += struct.pack("<I7dI", i, *pose, 4) + name.encode() + b"\0" + struct.pack("<Q", 2 * i) + bytes(24 * 2 * i)
    points = struct.pack("<Q", len(POINTS))
    for i, (xyz, rgb, track) in enumerate(POINTS):
        points += struct.pack("<Q3d3BdQ", i, *xyz, *rgb, 0.5, track) + bytes(8 * track)
    for name, content in (("cameras", cameras), ("images", images), ("points3D", points)):
        (folder / f"{name}.bin").write_bytes(content)


@pytest.mark.parametrize("write", [write_txt, write_bin])
@pytest.mark.parametrize("model", MODEL_PARAMS)
def test_models(tmp_path: Path, model: str, write: Callable[[Path, str], None]) -> None:
    write(tmp_path, model)
    views, (points, colors) = read_colmap(tmp_path, tmp_path / "images")
    assert [view.name for view in views] == list(POSES)
    assert views[0].folder / views[0].file == tmp_path / "images" / "b c.jpg"
    assert views[0].lens == LENSES[model]
    np.testing.assert_allclose(views[0].viewmat, [[0, 0, 1, 1], [1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 0, 1]], atol=1e-15)
    np.testing.assert_allclose(views[1].viewmat[:3], [[1, 0, 0, -1], [0, 1, 0, 0.5], [0, 0, 1, 0.25]], atol=1e-15)
    assert points.dtype == colors.dtype == np.float32
    np.testing.assert_array_equal(points, [xyz for xyz, _, _ in POINTS])
    np.testing.assert_allclose(colors, np.array([rgb for _, rgb, _ in POINTS]) / 255, rtol=1e-6)


def test_no_points(tmp_path: Path) -> None:
    write_bin(tmp_path, "PINHOLE")
    (tmp_path / "points3D.bin").write_bytes(bytes(8))
    assert read_colmap(tmp_path, tmp_path)[1][0].shape == (0, 3)
    for path in tmp_path.glob("*.bin"):
        path.unlink()
    write_txt(tmp_path, "PINHOLE")
    (tmp_path / "points3D.txt").write_text("# nothing\n\n")
    assert read_colmap(tmp_path, tmp_path)[1][0].shape == (0, 3)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_truncated(tmp_path: Path, name: str) -> None:
    write_bin(tmp_path, "OPENCV")
    whole = (tmp_path / name).read_bytes()
    for length in (0, 5, len(whole) // 3, len(whole) // 2, len(whole) - 1):
        (tmp_path / name).write_bytes(whole[:length])
        with pytest.raises(ValueError, match=rf"{name}: truncated: expected at least \d+ bytes; found {length}"):
            read_colmap(tmp_path, tmp_path)


def test_broken(tmp_path: Path) -> None:
    def refused(match: str, error: type[Exception] = ValueError) -> None:
        with pytest.raises(error, match=match):
            read_colmap(tmp_path, tmp_path)

    write_txt(tmp_path, "PINHOLE")
    cameras, images, points = (tmp_path / f"{name}.txt" for name in ("cameras", "images", "points3D"))
    cameras.write_text("4 THIN_PRISM_FISHEYE 64 48 1 2 3 4 5 6 7 8 9 10 11 12\n")
    refused("camera model THIN_PRISM_FISHEYE is not supported; expected one of SIMPLE_PINHOLE")
    cameras.write_text("4 PINHOLE 64 48 1 2 3\n")
    refused("PINHOLE: expected 4 parameters; got 3")
    cameras.write_text("4 PINHOLE 64\n")
    refused("expected a line CAMERA_ID MODEL")
    cameras.write_text("5 PINHOLE 64 48 1 2 3 4\n")
    refused("b c.jpg has the camera 4, which cameras.txt does not list")
    write_txt(tmp_path, "PINHOLE")
    images.write_text("1 0.5 0.5 0.5\n")
    refused("images.txt: expected a line IMAGE_ID")
    write_txt(tmp_path, "PINHOLE")
    points.write_text("1 0 1 2 255\n")
    refused("points3D.txt: expected POINT3D_ID")
    points.unlink()
    refused("points3D.txt: missing", FileNotFoundError)
    write_bin(tmp_path, "PINHOLE")
    for code, name in ((7, "FOV"), (99, "number 99")):
        (tmp_path / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 4, code, 64, 48, 1, 2, 3, 4))
        refused(f"camera model {name} is not supported")


def test_real_binary_is_text(data_root: Path) -> None:
    banana = data_root / "banana"
    views, points = read_colmap(banana / "sparse" / "0", banana / "images")
    text_views, text_points = read_colmap(banana / "sparse_txt", banana / "images")
    assert len(views) == 15
    assert points[0].shape == (9571, 3)
    for view, text in zip(views, text_views, strict=True):
        assert (view.name, view.lens) == (text.name, text.lens)
        np.testing.assert_allclose(view.viewmat, text.viewmat, atol=1e-14)
    for part, text_part in zip(points, text_points, strict=True):
        np.testing.assert_array_equal(part, text_part)
    assert views[0].lens == Lens(1500, 996, 2604.6964667447373, 2604.6964667447373, 750.5, 499.0)
