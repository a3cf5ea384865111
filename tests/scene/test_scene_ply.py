"""3DGS .ply: round trips, foreign files, broken files."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tsplat.scene import Gaussians, read_ply, write_image, write_ply
from tsplat.scene.ply import MAX_LOGIT, read_point_ply


def make(n: int, degree: int, seed: int = 0) -> Gaussians:
    torch.manual_seed(seed)
    rest = (degree + 1) ** 2 - 1
    return Gaussians(torch.randn(n, 3), torch.randn(n, 4), torch.randn(n, 3), torch.randn(n), torch.randn(n, 1, 3),
                     torch.randn(n, rest, 3))


def same(a: Gaussians, b: Gaussians) -> bool:
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in Gaussians.NAMES)


def write_columns(path: Path, columns: dict[str, np.ndarray], kinds: dict[str, str] | None = None, tail: str = "") -> None:
    """A binary .ply of these columns, in their order; `kinds` gives PLY types other than float."""
    kinds = {name: (kinds or {}).get(name, "float") for name in columns}
    numpy_kinds = {"float": "<f4", "double": "<f8", "uchar": "u1", "short": "<i2"}
    n = len(next(iter(columns.values())))
    rows = np.empty(n, [(name, numpy_kinds[kinds[name]]) for name in columns])
    for name, column in columns.items():
        rows[name] = column
    header = ["ply", "format binary_little_endian 1.0", "comment made by a test", f"element vertex {n}",
              *(f"property {kinds[name]} {name}" for name in columns), *([tail] if tail else []), "end_header", ""]
    path.write_bytes("\n".join(header).encode() + rows.tobytes())


def columns_of(gaussians: Gaussians) -> dict[str, np.ndarray]:
    with torch.no_grad():
        parts = {"x y z": gaussians.means, "f_dc_0 f_dc_1 f_dc_2": gaussians.sh0[:, 0],
                 "opacity": gaussians.opacity_logits[:, None],
                 "scale_0 scale_1 scale_2": gaussians.log_scales, "rot_0 rot_1 rot_2 rot_3": gaussians.quats}
        columns = {name: part[:, i].numpy() for names, part in parts.items() for i, name in enumerate(names.split())}
        per_channel = gaussians.sh_rest.shape[1]
        for channel in range(3):
            for k in range(per_channel):
                columns[f"f_rest_{channel * per_channel + k}"] = gaussians.sh_rest[:, k, channel].numpy()
    return columns


@pytest.mark.parametrize("degree", range(5))
@pytest.mark.parametrize("n", [0, 1, 100])
def test_round_trip(tmp_path: Path, n: int, degree: int) -> None:
    gaussians = make(n, degree)
    gaussians.save(tmp_path / "scene.ply")
    loaded = Gaussians.load(tmp_path / "scene.ply")
    assert loaded.sh_degree == degree
    assert same(loaded, gaussians)
    assert [path.name for path in tmp_path.iterdir()] == ["scene.ply"]


@settings(max_examples=30, deadline=None)
@given(degree=st.integers(0, 4), data=st.data())
def test_any_column_order(degree: int, data: st.DataObject) -> None:
    gaussians = make(3, degree)
    columns = columns_of(gaussians) | {"label": np.arange(3)}
    order = data.draw(st.permutations(list(columns)))
    doubles = data.draw(st.sets(st.sampled_from(sorted(columns))))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.ply"
        write_columns(path, {name: columns[name] for name in order}, dict.fromkeys(doubles, "double") | {"label": "short"})
        assert same(read_ply(path), gaussians)


def test_faces_after_the_vertices(tmp_path: Path) -> None:
    gaussians = make(4, 1)
    path = tmp_path / "scene.ply"
    write_columns(path, columns_of(gaussians), tail="element face 1\nproperty list uchar int vertex_indices")
    path.write_bytes(path.read_bytes() + b"\x03" + bytes(12))
    assert same(read_ply(path), gaussians)


def test_element_before_the_vertices(tmp_path: Path) -> None:
    gaussians = make(4, 0)
    path = tmp_path / "scene.ply"
    write_columns(path, columns_of(gaussians))
    header, _, body = path.read_bytes().partition(b"end_header\n")
    before = header.replace(b"element vertex", b"element camera 2\nproperty double t\nproperty uchar u\nelement vertex")
    path.write_bytes(before + b"end_header\n" + bytes(18) + body)
    assert same(read_ply(path), gaussians)
    path.write_bytes(before.replace(b"property double t", b"property list uchar int t") + b"end_header\n" + bytes(18) + body)
    with pytest.raises(ValueError, match="lists in or before"):
        read_ply(path)


def test_infinite_opacity_is_clamped(tmp_path: Path) -> None:
    columns = columns_of(make(3, 0))
    columns["opacity"] = np.array([np.inf, -np.inf, 2.0])
    write_columns(tmp_path / "scene.ply", columns)
    assert read_ply(tmp_path / "scene.ply").opacity_logits.tolist() == [MAX_LOGIT, -MAX_LOGIT, 2.0]


def test_refusals(tmp_path: Path) -> None:
    path = tmp_path / "scene.ply"
    good = columns_of(make(2, 1))

    def refused(match: str) -> None:
        with pytest.raises(ValueError, match=match) as caught:
            read_ply(path)
        assert str(path) in str(caught.value)

    write_columns(path, {name: column for name, column in good.items() if name not in ("opacity", "rot_2")})
    refused("needs the columns opacity, rot_2")
    write_columns(path, good | {"f_rest_9": good["x"]})
    refused("expected 0, 9, 24, 45, 72 columns")
    write_columns(path, {name.replace("f_rest_8", "f_rest_9"): column for name, column in good.items()})
    refused("expected 0, 9, 24, 45, 72 columns")

    write_columns(path, good)
    whole = path.read_bytes()
    path.write_bytes(whole[:-5])
    refused(f"truncated: expected {len(whole)} bytes for 2 rows of `vertex`; found {len(whole) - 5}")
    path.write_bytes(whole.replace(b"binary_little_endian", b"binary_big_endian"))
    refused("expected a binary_little_endian .ply of Gaussians; got binary_big_endian")
    path.write_bytes(whole.replace(b"binary_little_endian", b"ascii"))
    refused("got ascii")
    path.write_bytes(whole.replace(b"property float opacity", b"property float x"))
    refused("needs the columns opacity")
    path.write_bytes(whole.replace(b"property float f_rest_0", b"property float x"))
    refused("columns f_rest_0, f_rest_1, ...; got 8")
    path.write_bytes(whole.replace(b"property float x\n", b"property quaternion x\n"))
    refused("expected a .ply header line; got 'property quaternion x'")
    path.write_bytes(whole.replace(b"element vertex", b"element points"))
    refused("expected an element `vertex`; got points")
    path.write_bytes(whole.replace(b"end_header", b"comment oh"))
    refused("no end_header|header line")
    path.write_bytes(b"PK\x03\x04 something else")
    refused("begins with `ply`")
    write_columns(path, {f"packed_{name}": np.arange(2) for name in ("position", "rotation", "scale", "color")})
    refused("PlayCanvas compressed")
    write_columns(path, good | {"a": good["x"], "b": good["x"]})
    path.write_bytes(path.read_bytes().replace(b"property float b\n", b"property float a\n"))
    refused("not distinct")
    with pytest.raises(FileNotFoundError):
        read_ply(tmp_path / "absent.ply")


@contextmanager
def full_disk(limit: int) -> Iterator[None]:
    """Files cannot grow beyond `limit` bytes."""
    resource = pytest.importorskip("resource", reason="needs POSIX file size limits")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_full_disk_leaves_the_old_file(tmp_path: Path) -> None:
    old = make(2, 0)
    write_ply(tmp_path / "scene.ply", old)
    write_image(tmp_path / "image.png", torch.zeros(4, 4, 3))
    before = (tmp_path / "image.png").read_bytes()
    with full_disk(4096):
        with pytest.raises(OSError, match=r"large|space"):
            write_ply(tmp_path / "scene.ply", make(10_000, 3))
        with pytest.raises(OSError, match=r"image\.png"):
            write_image(tmp_path / "image.png", torch.rand(100, 100, 3))
    assert same(read_ply(tmp_path / "scene.ply"), old)
    assert (tmp_path / "image.png").read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["image.png", "scene.ply"]


def test_point_cloud(tmp_path: Path) -> None:
    path = tmp_path / "points.ply"
    head = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
    colored = head + "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    path.write_text(colored + "end_header\n0 1 2 255 0 51\n3 4 5 0 255 0\n")
    points, colors = read_point_ply(path)
    assert points.tolist() == [[0, 1, 2], [3, 4, 5]]
    np.testing.assert_allclose(colors, [[1, 0, 0.2], [0, 1, 0]], rtol=1e-6)
    path.write_text(head + "end_header\n0 1 2\n")
    with pytest.raises(ValueError, match="expected 2 rows"):
        read_point_ply(path)
    write_columns(path, {"x": np.arange(3), "y": np.arange(3), "z": np.arange(3)}, {"y": "double"})
    points, colors = read_point_ply(path)
    assert points.tolist() == [[0, 0, 0], [1, 1, 1], [2, 2, 2]]
    assert colors is None
    write_columns(path, {"x": np.arange(3), "y": np.arange(3)})
    with pytest.raises(ValueError, match="columns x, y, z"):
        read_point_ply(path)
    path.write_text(head.replace("ascii", "binary_big_endian") + "end_header\n")
    with pytest.raises(ValueError, match="got binary_big_endian"):
        read_point_ply(path)


@pytest.mark.parametrize(("name", "n", "degree"), [("inria_train_first1000", 1000, 3), ("massa", 58_649, 0),
                                                   ("playbot_lod3_31k", 31_000, 2)])
def test_real_files(data_root: Path, tmp_path: Path, name: str, n: int, degree: int) -> None:
    path = data_root / "splats" / f"{name}.ply"
    gaussians = read_ply(path)
    assert (len(gaussians), gaussians.sh_degree) == (n, degree)
    assert all(parameter.isfinite().all() for parameter in gaussians.parameters())
    write_ply(tmp_path / "again.ply", gaussians)
    assert same(read_ply(tmp_path / "again.ply"), gaussians)
    if name.startswith("inria"):
        assert (tmp_path / "again.ply").stat().st_size == path.stat().st_size
        norms = gaussians.quats.norm(dim=1)                         # read raw: normalising is the renderer's part
        assert (round(norms.min().item(), 3), round(norms.max().item(), 3)) == (0.642, 1.319)


def test_real_compressed_file(data_root: Path) -> None:
    with pytest.raises(ValueError, match="PlayCanvas compressed"):
        read_ply(data_root / "splats" / "playbot_lod2_125k.compressed.ply")
