"""transforms.json in its dialects: Blender, instant-ngp, nerfstudio."""

import json
import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tsplat.scene import Lens, read_transforms, write_image

POSE = [[1, 0, 0, 1], [0, 0, -1, 2], [0, 1, 0, 3], [0, 0, 0, 1]]      # camera-to-world, OpenGL axes: looks along world +y
Make = Callable[..., Path]


@pytest.fixture
def make(tmp_path: Path, ramp: Callable[..., Tensor]) -> Make:
    def write(document: dict[str, Any], photos: tuple[str, ...] = ("images/a.png",), size: tuple[int, int] = (20, 10)) -> Path:
        for photo in photos:
            (tmp_path / photo).parent.mkdir(exist_ok=True)
            write_image(tmp_path / photo, ramp(*size))
        path = tmp_path / "transforms.json"
        path.write_text(json.dumps({"frames": [{"file_path": "images/a.png", "transform_matrix": POSE}], **document}))
        return path

    return write


def only_lens(path: Path) -> Lens:
    (view,), _ = read_transforms(path)
    return view.lens


def test_blender(make: Make, tmp_path: Path) -> None:
    path = make({"camera_angle_x": 0.8, "frames": [{"file_path": "./train/r_0", "transform_matrix": POSE}]}, ("train/r_0.png",))
    (view,), points = read_transforms(path)
    assert points is None
    assert view.name == "train/r_0.png"
    assert view.folder / view.file == tmp_path / "train" / "r_0.png"
    focal = 10 / math.tan(0.4)
    assert view.lens == Lens(20, 10, focal, focal, 10, 5)
    expected = [[1, 0, 0, -1], [0, 0, -1, 3], [0, 1, 0, -2], [0, 0, 0, 1]]                 # y down, z forward
    np.testing.assert_allclose(view.viewmat, expected, atol=1e-15)


def test_instant_ngp(make: Make) -> None:
    values = {"fl_x": 30.0, "cx": 9.0, "w": 20.0, "h": 10.0, "k1": 0.1, "p2": 0.2, "aabb_scale": 4}
    assert only_lens(make(values)) == Lens(20, 10, 30, 30, 9, 5, (0.1, 0, 0, 0.2, 0, 0, 0, 0))
    lens = only_lens(make({"camera_angle_x": 0.8, "camera_angle_y": 0.5}))
    assert lens.fy == pytest.approx(5 / math.tan(0.25))
    assert only_lens(make({**values, "is_fisheye": True})).fisheye


def test_nerfstudio(make: Make, tmp_path: Path) -> None:
    (tmp_path / "points.ply").write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
                                         "property float z\nend_header\n1 2 3\n")
    frame = {"file_path": "images/a.png", "transform_matrix": POSE[:3], "fl_x": 41.0, "w": 20, "h": 10, "mask_path": "m.png"}
    write_image(tmp_path / "m.png", torch.ones(10, 20, 1))
    document = {"camera_model": "OPENCV_FISHEYE", "fl_x": 40.0, "fl_y": 42.0, "cx": 10.0, "cy": 5.0, "k1": 0.1, "k4": 0.4,
                "applied_transform": [[0, 1, 0, 0]], "ply_file_path": "points.ply", "frames": [frame]}
    (view,), points = read_transforms(make(document))
    assert view.lens == Lens(20, 10, 41, 42, 10, 5, (0.1, 0, 0, 0.4), fisheye=True)
    assert view.mask == tmp_path / "m.png"
    assert points is not None
    assert points[0].tolist() == [[1, 2, 3]]
    with pytest.warns(UserWarning, match="ply_file_path cannot be read"):
        assert read_transforms(make({**document, "ply_file_path": "absent.ply"}))[1] is None
    with pytest.raises(FileNotFoundError, match=r"absent\.png: missing; it is the mask_path"):
        read_transforms(make({**document, "frames": [{**frame, "mask_path": "absent.png"}]}))


def test_missing_photos_are_skipped_with_one_warning(make: Make) -> None:
    frames = [{"file_path": f"images/{name}.png", "transform_matrix": POSE} for name in "abcd"]
    path = make({"fl_x": 30.0, "frames": frames}, ("images/b.png", "images/d.png"))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        views, _ = read_transforms(path)
    assert [view.name for view in views] == ["images/b.png", "images/d.png"]
    assert [str(warning.message).split(": ", 1)[1] for warning in caught] == [
        "skipped 2 of 4 frames, whose photos do not exist (the first is images/a.png)"]


def test_rounded_and_scaled_rotations(make: Make) -> None:
    pose = np.array(POSE, float)
    pose[:3, :3] *= 2.5
    frame = {"file_path": "images/a.png", "transform_matrix": pose.tolist()}
    (view,), _ = read_transforms(make({"fl_x": 30.0, "frames": [frame]}))
    np.testing.assert_allclose(view.viewmat[:3, :3] @ view.viewmat[:3, :3].T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(view.viewmat @ [1, 2, 3, 1], [0, 0, 0, 1], atol=1e-14)


def test_refusals(make: Make, tmp_path: Path) -> None:
    def refused(match: str, **document: Any) -> None:
        with pytest.raises(ValueError, match=match):
            read_transforms(make(document))

    refused("expected `fl_x` or `camera_angle_x`")
    refused("camera_model 'EQUIRECTANGULAR' is not supported", fl_x=1, camera_model="EQUIRECTANGULAR")
    refused("k4 = 0.5 is supported for OPENCV_FISHEYE only", fl_x=1, k4=0.5)
    refused("expected an object with a list `frames`", frames=3)
    refused("expected photos; none of its 0 frames", frames=[])
    refused("none of its 1 frames has one", frames=[{"file_path": "x", "transform_matrix": POSE}])
    refused("expected `transform_matrix` in every frame", frames=[{"file_path": "images/a.png"}])
    refused("finite 4x4 transform_matrix", fl_x=1, frames=[{"file_path": "images/a.png", "transform_matrix": [[1, 2], [3, 4]]}])
    mirrored = np.diag([1.0, 1, -1, 1]).tolist()
    refused("got a reflection", fl_x=1, frames=[{"file_path": "images/a.png", "transform_matrix": mirrored}])
    (tmp_path / "transforms.json").write_text("{")
    with pytest.raises(ValueError, match=r"transforms\.json: expected JSON"):
        read_transforms(tmp_path / "transforms.json")
