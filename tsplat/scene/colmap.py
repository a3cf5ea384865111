"""COLMAP sparse models, binary and text: cameras, images and points. Rigs, frames, 2D points and tracks are passed over.

The layouts are those of COLMAP's documentation (format.html): world-to-camera poses, quaternions wxyz, OpenCV axes,
the first pixel's centre at (0.5, 0.5).
"""

from __future__ import annotations

import os
import struct
from array import array
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from tsplat.scene.lens import Lens
from tsplat.scene.view import Points, View

MODEL_NAMES = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV",
               "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE")
MODEL_PARAMS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
}
Image = tuple[str, int, NDArray[np.float64]]      # name, camera id, viewmat


def is_colmap(folder: Path) -> bool:
    """Whether `folder` holds a COLMAP model itself."""
    return any((folder / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt"))


def read_colmap(folder: str | os.PathLike[str], images: str | os.PathLike[str]) -> tuple[list[View], Points]:
    """Read the model in `folder` (`.bin` rather than `.txt`), whose photos lie in the folder `images`.

    Raises:
        ValueError: naming the file, for a camera model that is not supported, a truncated file or a broken line.
        OSError: a file of the three is missing.
    """
    folder = Path(folder)
    suffix = ".bin" if (folder / "cameras.bin").is_file() else ".txt"
    cameras_path, images_path, points_path = (folder / (name + suffix) for name in ("cameras", "images", "points3D"))
    try:
        if suffix == ".bin":
            lenses, posed, points = _cameras_bin(cameras_path), _images_bin(images_path), _points_bin(points_path)
        else:
            lenses, posed, points = _cameras_txt(cameras_path), _images_txt(images_path), _points_txt(points_path)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{error.filename}: missing; a COLMAP model has cameras, images and points3D") from None
    views = []
    for name, camera, viewmat in posed:
        if camera not in lenses:
            raise ValueError(f"{images_path}: {name} has the camera {camera}, which {cameras_path.name} does not list")
        views.append(View(name, Path(images), name, viewmat, lenses[camera]))
    return views, points


def _lens(path: Path, model: str, width: int, height: int, values: tuple[float, ...]) -> Lens:
    names = MODEL_PARAMS[model].split()
    if len(values) != len(names):
        raise ValueError(f"{path}: camera model {model}: expected {len(names)} parameters; got {len(values)}")
    return Lens.of(width, height, dict(zip(names, values, strict=True)), fisheye=model == "OPENCV_FISHEYE")


def _check_model(path: Path, model: str) -> None:
    if model not in MODEL_PARAMS:
        raise ValueError(f"{path}: camera model {model} is not supported; expected one of {', '.join(MODEL_PARAMS)} "
                         "(COLMAP's image_undistorter makes PINHOLE of any)")


def _viewmat(quat: tuple[float, ...], translation: tuple[float, ...]) -> NDArray[np.float64]:
    w, x, y, z = np.asarray(quat) / np.linalg.norm(quat)
    viewmat = np.eye(4)
    viewmat[:3, :3] = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                       [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                       [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]
    viewmat[:3, 3] = translation
    return viewmat


# --- binary ---------------------------------------------------------------------------------------------------------


def _take(path: Path, file: BinaryIO, layout: str) -> tuple[float, ...]:
    size = struct.calcsize(layout)
    data = file.read(size)
    if len(data) < size:
        raise _truncated(path, file.tell() - len(data) + size)
    return struct.unpack(layout, data)


def _truncated(path: Path, expected: int) -> ValueError:
    return ValueError(f"{path}: truncated: expected at least {expected} bytes; found {path.stat().st_size}")


def _cameras_bin(path: Path) -> dict[int, Lens]:
    lenses = {}
    with path.open("rb") as file:
        (count,) = _take(path, file, "<Q")
        for _ in range(int(count)):
            camera, code, width, height = map(int, _take(path, file, "<iiQQ"))
            model = MODEL_NAMES[code] if 0 <= code < len(MODEL_NAMES) else f"number {code}"
            _check_model(path, model)
            lenses[camera] = _lens(path, model, width, height, _take(path, file, f"<{len(MODEL_PARAMS[model].split())}d"))
    return lenses


def _images_bin(path: Path) -> list[Image]:
    images: list[Image] = []
    with path.open("rb") as file:
        (count,) = _take(path, file, "<Q")
        for _ in range(int(count)):
            _, *pose, camera = _take(path, file, "<I7dI")
            name = bytearray()
            while (letter := file.read(1)) not in (b"\0", b""):
                name += letter
            (points,) = _take(path, file, "<Q")
            file.seek(24 * int(points), os.SEEK_CUR)                     # x, y, point id
            images.append((name.decode(), int(camera), _viewmat(tuple(pose[:4]), tuple(pose[4:]))))
        if file.tell() > path.stat().st_size:
            raise _truncated(path, file.tell())
    return images


def _points_bin(path: Path) -> Points:
    data = path.read_bytes()
    if len(data) < 8:
        raise _truncated(path, 8)
    (count,) = struct.unpack_from("<Q", data)
    starts, start, track_length = array("q"), 8, struct.Struct("<Q").unpack_from
    for _ in range(count):                                               # id u64, xyz f64, rgb u8, error f64, track
        if start + 51 > len(data):
            raise _truncated(path, start + 51)
        starts.append(start)
        start += 51 + 8 * track_length(data, start + 43)[0]
    if start > len(data):
        raise _truncated(path, start)
    if not count:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32)
    windows = np.lib.stride_tricks.sliding_window_view(np.frombuffer(data, np.uint8), 27)
    rows = windows[np.asarray(starts) + 8]                               # [M, 27] bytes: xyz, rgb
    xyz = rows[:, :24].copy().view("<f8")
    return xyz.astype(np.float32), rows[:, 24:].astype(np.float32) / np.float32(255)


# --- text -----------------------------------------------------------------------------------------------------------


def _cameras_txt(path: Path) -> dict[int, Lens]:
    lenses = {}
    for line in path.read_text().splitlines():
        if line.strip() and not line.startswith("#"):
            try:
                camera, model, width, height, *values = line.split()
                size, numbers = (int(width), int(height)), tuple(map(float, values))
            except ValueError:
                raise _broken(path, line, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS...") from None
            _check_model(path, model)
            lenses[int(camera)] = _lens(path, model, *size, numbers)
    return lenses


def _images_txt(path: Path) -> list[Image]:
    images: list[Image] = []
    with path.open(encoding="utf-8") as file:
        for line in file:
            if not line.strip() or line.startswith("#"):
                continue
            try:
                _, *pose, camera, name = line.strip().split(maxsplit=9)
                numbers = tuple(map(float, pose))
                images.append((name, int(camera), _viewmat(numbers[:4], numbers[4:])))
            except ValueError:
                raise _broken(path, line, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME") from None
            next(file, None)                                             # the 2D points, perhaps an empty line
    return images


def _points_txt(path: Path) -> Points:
    with path.open(encoding="utf-8") as file:
        if all(line.startswith("#") or not line.strip() for line in file):
            return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32)
    try:
        table = np.loadtxt(path, usecols=range(1, 7), ndmin=2)           # [M, 6] xyz, rgb
    except ValueError as error:
        raise ValueError(f"{path}: expected POINT3D_ID X Y Z R G B ERROR TRACK... in each line; {error}") from None
    return table[:, :3].astype(np.float32), table[:, 3:].astype(np.float32) / np.float32(255)


def _broken(path: Path, line: str, expected: str) -> ValueError:
    return ValueError(f"{path}: expected a line {expected}; got {line.strip()[:80]!r}")
