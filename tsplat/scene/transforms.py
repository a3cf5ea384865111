"""transforms.json as Blender scenes (NeRF-synthetic), instant-ngp and nerfstudio write it."""

from __future__ import annotations

import json
import math
import os
import warnings
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsplat.scene.image_files import image_size
from tsplat.scene.lens import Lens
from tsplat.scene.ply import read_point_ply
from tsplat.scene.view import Points, View

SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".webp")            # tried in turn: Blender's file_path has none
PERSPECTIVE = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL")
GL_TO_CV = np.diag([1.0, -1.0, -1.0, 1.0])                   # camera axes: x right, y up, z back -> x right, y down, z forward


def read_transforms(path: str | os.PathLike[str]) -> tuple[list[View], Points | None]:
    """Read the views of a transforms.json and the points of its `ply_file_path`, if it has one.

    Intrinsics are those of the frame, else those of the file: fl_x, fl_y, cx, cy, w, h, k1 to k4, p1, p2, or
    camera_angle_x alone (then the size is the photo's). `applied_transform` is already in the poses and so ignored.
    Frames whose photo does not exist are skipped, with one warning that counts them.

    Raises:
        ValueError: naming the file: broken JSON, no focal length, an unsupported camera_model, no photo at all.
    """
    path = Path(path)
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: expected JSON; {error}") from None
    frames = document.get("frames") if isinstance(document, dict) else None
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise ValueError(f"{path}: expected an object with a list `frames` of objects")
    views = []
    missing = []
    for frame in frames:
        for key in ("file_path", "transform_matrix"):
            if key not in frame:
                raise ValueError(f"{path}: expected `{key}` in every frame; got one with {', '.join(frame)}")
        name = _find(path.parent, str(frame["file_path"]))
        if name is None:
            missing.append(frame["file_path"])
            continue
        photo = path.parent / name
        mask = path.parent / frame["mask_path"] if frame.get("mask_path") else None
        if mask is not None and not mask.is_file():
            raise FileNotFoundError(f"{mask}: missing; it is the mask_path of a frame in {path}")
        lens = _lens(path, {**document, **frame}, photo)
        views.append(View(name, photo.parent, photo.name, _viewmat(path, frame), lens, mask))
    if not views:
        raise ValueError(f"{path}: expected photos; none of its {len(frames)} frames has one"
                         + (f" (looked for {path.parent / str(missing[0])})" if missing else ""))
    if missing:
        warnings.warn(f"{path}: skipped {len(missing)} of {len(frames)} frames, whose photos do not exist "
                      f"(the first is {missing[0]})", stacklevel=2)
    return views, _points(path, document.get("ply_file_path"))


def _find(root: Path, file_path: str) -> str | None:
    """The existing file that a `file_path` means, relative to `root`."""
    plain = str(PurePosixPath(file_path.replace("\\", "/")))
    return next((plain + suffix for suffix in SUFFIXES if (root / (plain + suffix)).is_file()), None)


def _viewmat(path: Path, frame: Mapping[str, Any]) -> NDArray[np.float64]:
    matrix = np.array(frame["transform_matrix"], dtype=np.float64)
    if matrix.shape not in ((4, 4), (3, 4)) or not np.isfinite(matrix).all():
        raise ValueError(f"{path}: {frame['file_path']}: expected a finite 4x4 transform_matrix; got {matrix.tolist()}")
    left, _, right = np.linalg.svd(matrix[:3, :3])           # the nearest rotation: some files hold rounded or scaled ones
    if np.linalg.det(left @ right) < 0:
        raise ValueError(f"{path}: {frame['file_path']}: expected a rotation in transform_matrix; got a reflection")
    camera = np.eye(4)
    camera[:3, :3], camera[:3, 3] = left @ right, matrix[:3, 3]
    return np.asarray(np.linalg.inv(camera @ GL_TO_CV), np.float64)


def _lens(path: Path, values: Mapping[str, Any], photo: Path) -> Lens:
    model = values.get("camera_model", "OPENCV")
    fisheye = model == "OPENCV_FISHEYE" or bool(values.get("is_fisheye"))
    if model not in PERSPECTIVE and not fisheye:
        raise ValueError(f"{path}: camera_model {model!r} is not supported; expected one of {', '.join(PERSPECTIVE)}, "
                         "OPENCV_FISHEYE")
    if values.get("k4") and not fisheye:
        raise ValueError(f"{path}: k4 = {values['k4']} is supported for OPENCV_FISHEYE only")
    width, height = (values["w"], values["h"]) if "w" in values and "h" in values else image_size(photo)
    params = {key: float(values[key]) for key in ("k1", "k2", "k3", "k4", "p1", "p2") if key in values}
    for axis, size in (("x", float(width)), ("y", float(height))):
        if f"fl_{axis}" in values:
            params[f"f{axis}"] = float(values[f"fl_{axis}"])
        elif f"camera_angle_{axis}" in values:
            params[f"f{axis}"] = 0.5 * size / math.tan(0.5 * float(values[f"camera_angle_{axis}"]))
        params[f"c{axis}"] = float(values.get(f"c{axis}", size / 2))
    if "fx" not in params:
        raise ValueError(f"{path}: expected `fl_x` or `camera_angle_x`, for {photo.name}; got neither")
    return Lens.of(round(width), round(height), params, fisheye=fisheye)


def _points(path: Path, ply: str | None) -> Points | None:
    if ply is None:
        return None
    try:
        return read_point_ply(path.parent / ply)
    except (OSError, ValueError) as error:
        warnings.warn(f"{path}: no initial points, as ply_file_path cannot be read: {error}", stacklevel=3)
        return None
