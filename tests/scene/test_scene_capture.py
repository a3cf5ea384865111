"""Whole captures: layouts, splits, sizes, missing photos, and the real ones."""

import json
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from tsplat.scene import Capture, load_capture, write_image

Folder = Callable[..., Path]
Ramp = Callable[..., Tensor]


def test_colmap(colmap_folder: Folder, ramp: Ramp) -> None:
    capture = load_capture(colmap_folder(10))
    assert len(capture) == 10
    assert capture.names == [f"{i:03d}.png" for i in range(10)]
    assert capture.test == [0, 8]
    assert capture.train == [1, 2, 3, 4, 5, 6, 7, 9]
    assert capture.viewmats.dtype == capture.Ks.dtype == torch.float32
    camera = capture.camera(3)
    assert (camera.width, camera.height, camera.model) == (24, 16, "pinhole")
    assert camera.viewmats[:3, 3].tolist() == [-3, 0, 0]
    assert camera.Ks.tolist() == [[20, 0, 12], [0, 20, 8], [0, 0, 1]]
    assert (capture.images[3] - ramp(24, 16, phase=3.0)).abs().max() < 1 / 255
    assert capture.points is not None
    assert capture.point_colors is not None
    assert capture.points.tolist() == [[0, 1, 2], [3, 4, 5]]
    torch.testing.assert_close(capture.point_colors, torch.tensor([[1, 0, 0.2], [0, 1, 0]]))
    assert capture.extent == pytest.approx(1.1 * 4.5)                # cameras at x = 0..9
    assert not capture.masked


@pytest.mark.parametrize("model", ["sparse/0", "sparse", "colmap/sparse/0", "."])
def test_layouts(colmap_folder: Folder, model: str) -> None:
    assert len(load_capture(colmap_folder(3, model=model))) == 3


def test_model_folder_itself(colmap_folder: Folder) -> None:
    assert len(load_capture(colmap_folder(3) / "sparse" / "0")) == 3


def test_order_and_split(colmap_folder: Folder) -> None:
    folder = colmap_folder(names=["cam2/b.png", "cam1/c.png", "cam2/a.png"])
    capture = load_capture(folder, test_every=2)
    assert capture.names == ["cam1/c.png", "cam2/a.png", "cam2/b.png"]
    assert capture.viewmats[:, 0, 3].tolist() == [-1, -2, 0]
    assert (capture.train, capture.test) == ([1], [0, 2])
    everything = load_capture(folder, test_every=0)
    assert (everything.train, everything.test) == ([0, 1, 2], [])
    with pytest.raises(ValueError, match="test_every"):
        load_capture(folder, test_every=-1)


@pytest.mark.parametrize(("downscale", "size"), [(2, (12, 8)), (1.5, (16, 11)), (3, (8, 5)), (100, (1, 1))])
def test_downscale(colmap_folder: Folder, downscale: float, size: tuple[int, int]) -> None:
    capture = load_capture(colmap_folder(2), downscale=downscale)
    assert (capture.width[0], capture.height[0]) == size
    assert capture.images[0].shape == (size[1], size[0], 3)
    x, y = size[0] / 24, size[1] / 16
    torch.testing.assert_close(capture.Ks[0], torch.tensor([[20 * x, 0, 12 * x], [0, 20 * y, 8 * y], [0, 0, 1]]))


def test_downscale_refuses(colmap_folder: Folder) -> None:
    with pytest.raises(ValueError, match=r"downscale: expected at least 1; got 0\.5"):
        load_capture(colmap_folder(1), downscale=0.5)


def test_ready_made_smaller_photos(colmap_folder: Folder) -> None:
    folder = colmap_folder(2)
    (folder / "images_2").mkdir()
    write_image(folder / "images_2" / "000.png", torch.full((8, 12, 3), 0.5))
    capture = load_capture(folder, downscale=2)
    assert capture.images[0].unique().numel() == 1                   # from images_2
    assert capture.images[1].unique().numel() > 1                    # from images, reduced
    assert capture.width == [12, 12]
    torch.testing.assert_close(capture.Ks[0], capture.Ks[1])
    shutil.rmtree(folder / "images")
    with pytest.warns(UserWarning, match="skipped 1 of 2"):
        assert load_capture(folder, downscale=2).names == ["000.png"]


def test_photos_at_another_scale(colmap_folder: Folder) -> None:
    capture = load_capture(colmap_folder(1, camera="PINHOLE 48 32 40 40 24 16"))
    assert capture.Ks[0].tolist() == [[20, 0, 12], [0, 20, 8], [0, 0, 1]]


def test_photos_of_another_shape(colmap_folder: Folder) -> None:
    with pytest.raises(ValueError, match=r"000\.png: the photo is 24x16; expected the 16x24 of its camera"):
        load_capture(colmap_folder(1, camera="PINHOLE 16 24 20 20 8 12"))


def test_distorted_photos(colmap_folder: Folder) -> None:
    capture = load_capture(colmap_folder(1, camera="SIMPLE_RADIAL 24 16 20 12 8 0.2"))
    assert capture.images[0].shape == (16, 24, 3)
    assert capture.Ks[0, 0, 0] > 20


def test_impossible_distortion_names_the_photo(colmap_folder: Folder) -> None:
    with pytest.raises(ValueError, match=r"000\.png: lens: the distortion .* cannot be undone"):
        load_capture(colmap_folder(1, camera="SIMPLE_RADIAL 24 16 5 12 8 3"))


def test_no_photos(colmap_folder: Folder) -> None:
    folder = colmap_folder(3)
    for path in (folder / "images").iterdir():
        path.unlink()
    with pytest.raises(FileNotFoundError, match=r"found none of 3 \(looked for 000\.png\)"):
        load_capture(folder)
    (folder / "images").rmdir()
    with pytest.raises(FileNotFoundError, match=r"needs its photos; looked for .*images"):
        load_capture(folder)


def test_some_photos_missing(colmap_folder: Folder) -> None:
    folder = colmap_folder(10)
    for i in (0, 4):
        (folder / "images" / f"{i:03d}.png").unlink()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        capture = load_capture(folder)
    assert len(caught) == 1
    assert "skipped 2 of 10 photos" in str(caught[0].message)
    assert Path(caught[0].filename) == Path(__file__)
    assert capture.names[0] == "001.png"
    assert capture.test == [0]                                       # counted over the photos that exist


def test_photo_that_is_no_image(colmap_folder: Folder) -> None:
    folder = colmap_folder(2)
    (folder / "images" / "001.png").write_text("not an image")
    with pytest.raises(ValueError, match=r"001\.png: expected an image"):
        load_capture(folder)


@pytest.mark.parametrize("mask", ["masks/000.png", "masks/000.png.png", "images/000_mask.png", "images/000.png.mask.png"])
def test_masks(colmap_folder: Folder, mask: str) -> None:
    folder = colmap_folder(2)
    (folder / mask).parent.mkdir(exist_ok=True)
    write_image(folder / mask, torch.zeros(16, 24, 1))
    capture = load_capture(folder, downscale=2)
    assert capture.masked
    assert capture.images[0].shape == (8, 12, 4)
    assert not capture.images[0][..., 3].any()
    assert capture.images[1].shape == (8, 12, 3)


def test_nothing_there(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="it does not exist"):
        load_capture(tmp_path / "absent")
    with pytest.raises(FileNotFoundError, match=r"looked for sparse/0/cameras\.bin.*transforms\.json"):
        load_capture(tmp_path)
    (tmp_path / "file.txt").write_text("")
    with pytest.raises(ValueError, match=r"expected a folder or a \.json file"):
        load_capture(tmp_path / "file.txt")


def write_blender(folder: Path, split: str, names: list[str], ramp: Ramp) -> None:
    (folder / split).mkdir()
    frames = []
    for i, name in enumerate(names):
        write_image(folder / split / f"{name}.png", torch.cat([ramp(10, 10), torch.full((10, 10, 1), 0.5)], dim=2))
        pose = torch.eye(4)
        pose[0, 3] = i
        frames.append({"file_path": f"./{split}/{name}", "transform_matrix": pose.tolist()})
    (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames}))


def test_blender_split(tmp_path: Path, ramp: Ramp) -> None:
    write_blender(tmp_path, "train", ["r_1", "r_0", "r_2"], ramp)
    assert load_capture(tmp_path).test == [0]                        # no file for the split: every 8th
    write_blender(tmp_path, "test", ["r_0"], ramp)
    capture = load_capture(tmp_path)
    assert [capture.names[i] for i in capture.train] == ["train/r_0.png", "train/r_1.png", "train/r_2.png"]
    assert [capture.names[i] for i in capture.test] == ["test/r_0.png"]
    assert capture.points is None
    assert capture.images[0].shape == (10, 10, 4)
    assert not capture.masked
    single = load_capture(tmp_path / "transforms_train.json")
    assert single.names == ["train/r_0.png", "train/r_1.png", "train/r_2.png"]


def test_one_camera_has_an_extent(colmap_folder: Folder) -> None:
    assert load_capture(colmap_folder(1)).extent == 1.0


# --- real captures --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["fox", "banana"])
def test_real_json_is_colmap(data_root: Path, name: str) -> None:
    model, document = load_capture(data_root / name), load_capture(data_root / name / "transforms.json")
    assert ["images/" + photo for photo in model.names] == document.names
    torch.testing.assert_close(model.viewmats, document.viewmats, atol=1e-6, rtol=0)
    torch.testing.assert_close(model.Ks, document.Ks)
    assert (model.width, model.height, model.test) == (document.width, document.height, document.test)
    assert torch.equal(model.images[0], document.images[0])
    assert model.points is not None
    assert document.points is None


@pytest.mark.parametrize(("downscale", "size"), [(1, (1500, 996)), (2, (750, 498)), (4, (375, 249)), (8, (188, 124))])
def test_real_sizes(data_root: Path, downscale: int, size: tuple[int, int]) -> None:
    capture = load_capture(data_root / "banana", downscale=downscale)
    assert (capture.width[0], capture.height[0]) == size
    assert capture.images[0].shape == (size[1], size[0], 3)
    assert capture.Ks[0, 0, 0].item() == pytest.approx(2604.6965 * size[0] / 1500)
    folder = capture.images.photos[0].path.parent.name
    assert folder == {2: "images_2", 4: "images_4"}.get(downscale, "images")


def test_real_missing_photos(data_root: Path, tmp_path: Path) -> None:
    fox = data_root / "fox"
    for name in ("transforms_original_ngp.json", "images"):
        (tmp_path / name).symlink_to(fox / name)
    with pytest.warns(UserWarning, match="skipped 17 of 67 frames") as caught:
        capture = load_capture(tmp_path / "transforms_original_ngp.json", downscale=2)
    assert len(caught) == 1
    assert len(capture) == 50


def pixel_error(bent: Capture, straight: Capture, index: int) -> float:
    """PSNR of photo `index` of `bent` against the one of `straight`, resampled into its camera."""
    image, reference = bent.images[index], straight.images[index]
    K, K_reference = bent.Ks[index], straight.Ks[index]
    y, x = torch.meshgrid(torch.arange(image.shape[0]) + 0.5, torch.arange(image.shape[1]) + 0.5, indexing="ij")
    pixels = torch.stack([x, y, torch.ones_like(x)], -1) @ (K_reference @ K.inverse()).T        # [H, W, 3]
    size = torch.tensor([reference.shape[1], reference.shape[0]])
    inside = ((pixels[..., :2] > 1) & (pixels[..., :2] < size - 1)).all(-1)
    grid = pixels[..., :2] / size * 2 - 1
    resampled = grid_sample(reference.permute(2, 0, 1)[None], grid[None], align_corners=False)[0].permute(1, 2, 0)
    return -10 * float((resampled - image)[inside].square().mean().log10())


def test_real_distorted_photos(data_root: Path) -> None:
    """Our undistortion against COLMAP's: 39 dB, as both are JPEGs, sampled differently. Left bent, it is 33 dB."""
    bent = load_capture(data_root / "fox" / "transforms_distorted_4.json")
    straight = load_capture(data_root / "fox", downscale=2)
    torch.testing.assert_close(bent.viewmats, straight.viewmats, atol=1e-5, rtol=0)
    assert (bent.width[0], bent.height[0]) == (270, 480)
    for index in (0, 7, 20, 33, 49):
        assert pixel_error(bent, straight, index) > 37.5


def test_real_blender(data_root: Path) -> None:
    capture = load_capture(data_root / "nerf_synthetic_chair")
    assert (len(capture.train), len(capture.test)) == (100, 13)
    assert all(capture.names[i].startswith("test/") for i in capture.test)
    torch.testing.assert_close(capture.Ks[0], torch.tensor([[555.5555, 0, 200], [0, 555.5555, 200], [0, 0, 1]]))
    assert capture.images[0].shape == (400, 400, 4)
    rotations, translations = capture.viewmats[:, :3, :3], capture.viewmats[:, :3, 3:]
    radii = (rotations.mT @ translations).norm(dim=1)
    torch.testing.assert_close(radii, torch.full_like(radii, 4.031), atol=0.01, rtol=0)
    origin = (capture.Ks @ translations)[..., 0]                     # all look at the origin
    torch.testing.assert_close(origin[:, :2] / origin[:, 2:], torch.full((113, 2), 200.0), atol=0.5, rtol=0)
    half = load_capture(data_root / "nerf_synthetic_chair", downscale=2)
    assert half.images[0].shape == (200, 200, 4)


def test_real_points_project_onto_the_photos(data_root: Path) -> None:
    """The colour of a sparse point is close to the photo's where it projects: the axes are right."""
    capture = load_capture(data_root / "fox", downscale=2)
    assert capture.points is not None
    assert capture.point_colors is not None
    camera, image = capture.camera(5), capture.images[5]
    seen = capture.points @ camera.viewmats[:3, :3].T + camera.viewmats[:3, 3]
    pixels = seen @ camera.Ks.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    inside = (seen[:, 2] > 0) & (pixels > 0).all(1) & (pixels < torch.tensor([camera.width, camera.height])).all(1)
    column, row = pixels[inside].long().unbind(1)
    error = (image[row, column] - capture.point_colors[inside]).abs().mean(1)
    shuffled = (image[row, column] - capture.point_colors[inside].flip(0)).abs().mean(1)
    assert inside.sum() > 2000
    assert error.median() < 0.5 * shuffled.median()
