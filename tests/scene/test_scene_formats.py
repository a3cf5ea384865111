"""File formats of Gaussians: round trips within the steps of their codes, real files against their .ply twins, what is left out."""

import itertools
import json
import math
import struct
import sys
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

import tsplat
from tsplat.cli import main
from tsplat.scene import Gaussians
from tsplat.scene.formats import FORMATS, find_format
from tsplat.scene.formats.compressed_ply import CHUNK, nearby_order
from tsplat.scene.formats.fields import UP_AND_BACK, Fields
from tsplat.scene.formats.spz import write_spz
from tsplat.scene.gaussians import SH_C0
from tsplat.scene.ply import MAX_LOGIT

ROUNDING = 1e-6                     # float32, of values around 1 to 8
STEP = 0.5 / 255                    # half a step of 8 bits


def make(n: int, degree: int) -> Gaussians:
    """Random Gaussians within what all formats can hold."""
    rest = (degree + 1) ** 2 - 1
    return Gaussians(3 * torch.randn(n, 3), torch.randn(n, 4), torch.randn(n, 3) - 4, 2 * torch.randn(n), torch.rand(n, 1, 3) * 3 - 1.5,
                     1.8 * torch.rand(n, rest, 3) - 0.9)


def picked(gaussians: Gaussians, rows: Tensor) -> Gaussians:
    return Gaussians(*(getattr(gaussians, name)[rows] for name in Gaussians.NAMES))


def differences(a: Gaussians, b: Gaussians) -> dict[str, float]:
    """The largest of each parameter; of opacities rather than logits, of quaternions of the same sign and length 1."""
    with torch.no_grad():
        quats, others = (torch.nn.functional.normalize(g.quats.double(), dim=1) for g in (a, b))
        others = others * torch.where((quats * others).sum(1, keepdim=True) < 0, -1, 1)
        pairs = {name: (getattr(a, name), getattr(b, name)) for name in ("means", "log_scales", "opacities", "sh0", "sh_rest")}
        return {name: float((x - y).abs().max()) if x.numel() else 0.0 for name, (x, y) in (pairs | {"quats": (quats, others)}).items()}


def agree(a: Gaussians, b: Gaussians, **bounds: float) -> None:
    found = differences(a, b)
    assert found.keys() == bounds.keys()
    assert {name: value for name, value in found.items() if value > bounds[name]} == {}


def draw(gaussians: Gaussians, target: tuple[float, float, float] = (0.0, -0.4, 0.0)) -> Tensor:
    camera = tsplat.Camera.look_at((0.0, -1.0, -2.2), target, width=120, height=90, fov=50)
    with torch.no_grad():
        return tsplat.rasterize(gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh, camera,
                                sh_degree=gaussians.sh_degree, background=torch.ones(3)).image


def psnr(a: Tensor, b: Tensor) -> float:
    return -10 * math.log10(float((a - b).square().mean()) + 1e-20)


@pytest.mark.parametrize("degree", range(5))
@pytest.mark.parametrize("version", [2, 3])
def test_spz_round_trip(tmp_path: Path, degree: int, version: int) -> None:
    gaussians = make(300, degree)
    write_spz(tmp_path / "a.spz", gaussians, version)
    loaded = Gaussians.load(tmp_path / "a.spz")
    # The largest component follows from the others: its error is theirs times their ratio, at most 3; the real one, which version 2
    # leaves out, may be 0, where a step of the others is a root of it.
    quats = 3 * 0.5 / 511 / math.sqrt(2) if version == 3 else math.sqrt(2 * math.sqrt(3) * 0.5 / 127.5 + 3 * (0.5 / 127.5) ** 2)
    agree(loaded, gaussians, means=0.5 / 4096 + ROUNDING, log_scales=1 / 32 + ROUNDING, opacities=STEP + ROUNDING, sh0=STEP / 0.15 + ROUNDING,
          sh_rest=(8 + 0.5) / 128 + ROUNDING, quats=quats + ROUNDING)
    if degree:
        assert float((loaded.sh_rest - gaussians.sh_rest).detach()[:, :3].abs().max()) <= (4 + 0.5) / 128 + ROUNDING
    write_spz(tmp_path / "b.spz", loaded, version)
    agree(Gaussians.load(tmp_path / "b.spz"), loaded, means=0, log_scales=0, opacities=0, sh0=0, sh_rest=0, quats=quats)


def test_spz_far_means(tmp_path: Path) -> None:
    gaussians = picked(make(2, 0), torch.tensor([0, 1]))
    gaussians.means.data[0, 0] = -50_000.0
    gaussians.save(tmp_path / "a.spz")
    assert float((Gaussians.load(tmp_path / "a.spz").means - gaussians.means).detach().abs().max()) <= 0.5 / 2 ** 6         # 2^22 / 2^16
    gaussians.means.data[0, 0] = 5e6
    with pytest.raises(ValueError, match=r"\.spz holds means up to 4194304"):
        gaussians.save(tmp_path / "a.spz")
    with pytest.raises(ValueError, match="version: expected 2 or 3; got 4"):
        write_spz(tmp_path / "a.spz", gaussians, 4)


def test_splat_round_trip(tmp_path: Path) -> None:
    gaussians = make(300, 0)
    gaussians.save(tmp_path / "a.splat")
    loaded = Gaussians.load(tmp_path / "a.splat")
    assert float((loaded.quats - torch.nn.functional.normalize(gaussians.quats, dim=1)).detach().abs().max()) <= 1 / 128       # 1 itself is 127/128
    agree(loaded, gaussians, means=0, log_scales=ROUNDING, opacities=STEP + ROUNDING, sh0=STEP / SH_C0 + ROUNDING, sh_rest=0, quats=2 / 128)
    gaussians.log_scales.data[0, 2] = -math.inf
    gaussians.save(tmp_path / "a.splat")
    assert Gaussians.load(tmp_path / "a.splat").log_scales[0, 2].item() == pytest.approx(math.log(np.finfo(np.float32).tiny))


@pytest.mark.parametrize("degree", range(4))
def test_glb_round_trip(tmp_path: Path, degree: int) -> None:
    gaussians = make(300, degree)
    gaussians.save(tmp_path / "a.glb")
    agree(Gaussians.load(tmp_path / "a.glb"), gaussians, means=0, log_scales=ROUNDING, opacities=ROUNDING, sh0=0, sh_rest=0, quats=ROUNDING)


@pytest.mark.parametrize(("n", "degree"), [(1, 0), (CHUNK, 1), (600, 2), (600, 3)])
def test_compressed_ply_round_trip(tmp_path: Path, n: int, degree: int) -> None:
    gaussians = make(n, degree)
    gaussians.save(tmp_path / "a.compressed.ply")
    loaded = Gaussians.load(tmp_path / "a.compressed.ply")
    ordered = picked(gaussians, torch.from_numpy(nearby_order(gaussians.means.detach().numpy())))
    with torch.no_grad():
        for start in range(0, n, CHUNK):                            # codes are parts of the range of a chunk
            a, b = (picked(g, torch.arange(start, min(start + CHUNK, n))) for g in (loaded, ordered))
            for name, levels in (("means", (2047, 1023, 2047)), ("log_scales", (2047, 1023, 2047)), ("sh0", (255, 255, 255))):
                x, y = getattr(a, name).view(-1, 3), getattr(b, name).view(-1, 3)
                assert ((x - y).abs().amax(0) <= 0.5 * (y.amax(0) - y.amin(0)) / torch.tensor(levels) + ROUNDING).all()
    found = differences(loaded, ordered)
    assert found["opacities"] <= STEP + ROUNDING
    assert found["sh_rest"] <= 8 / 256 / 2 + ROUNDING
    assert found["quats"] <= 3 * 0.5 * math.sqrt(2) / 1023 + ROUNDING


def test_order_of_chunks() -> None:
    grid = np.stack(np.meshgrid(*[np.arange(16, dtype=np.float32)] * 3), axis=-1).reshape(-1, 3)
    order = nearby_order(grid)
    assert sorted(order) == list(range(4096))
    assert (np.ptp(grid[order].reshape(-1, CHUNK, 3), axis=1) == [7, 7, 3]).all()         # 16 blocks of 8 x 8 x 4 points


@pytest.mark.parametrize("name", ["a.spz", "a.splat", "a.glb", "a.compressed.ply"])
def test_what_cannot_be_written_is_left_out(tmp_path: Path, name: str) -> None:
    gaussians = make(5, 4)
    gaussians.means.data[0, 1] = math.nan
    gaussians.quats.data[1] = 0
    gaussians.opacity_logits.data[2] = math.inf
    gaussians.quats.data[3] *= 1e25                                 # whose square is beyond float32
    highest = {"a.spz": 4, "a.splat": 0}.get(name, 3)
    with pytest.warns(UserWarning, match="left out") as warned:
        gaussians.save(tmp_path / name)
    texts = [str(warning.message) for warning in warned]
    assert texts[0] == f"{tmp_path / name}: 2 of 5 splats with NaN, infinity or no rotation are left out"
    assert texts[1:] == ([] if highest == 4 else [f"{tmp_path / name}: this format holds spherical harmonics up to degree {highest}; "
                                                  "those beyond are left out"])
    loaded = Gaussians.load(tmp_path / name)
    assert (len(loaded), loaded.sh_degree) == (3, highest)
    assert sorted(loaded.opacity_logits.tolist())[2] == pytest.approx(MAX_LOGIT, abs=0.6 if name == "a.glb" else 0)     # float32 near 1
    assert all(parameter.isfinite().all() for parameter in loaded.parameters())


@pytest.mark.parametrize("name", ["a.ply", "a.spz", "a.splat", "a.compressed.ply"])
def test_no_splats(tmp_path: Path, name: str) -> None:
    make(0, 0).save(tmp_path / name)
    assert len(Gaussians.load(tmp_path / name)) == 0
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_glb_needs_splats(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="holds at least 1 splat; got 0"):
        make(0, 0).save(tmp_path / "a.glb")
    assert not list(tmp_path.iterdir())


def test_names(tmp_path: Path) -> None:
    gaussians = make(3, 1)
    gaussians.save(tmp_path / "a.ply")
    gaussians.save(tmp_path / "b.COMPRESSED.ply")
    (tmp_path / "b.COMPRESSED.ply").rename(tmp_path / "c.ply")      # the header says what a .ply is
    assert [find_format(tmp_path / name).name for name in ("a.ply", "c.ply", "x.SPZ", "x/meta.json")] == [
        "3DGS .ply", "PlayCanvas compressed .ply", "SPZ", "SOG"]
    assert Gaussians.load(tmp_path / "c.ply").sh_degree == 1
    for name in ("a.sog", "a.ksplat", "a.obj", "meta.json"):
        with pytest.raises(ValueError, match=r"ends in \.ply, \.compressed\.ply, \.splat, \.spz or \.glb; got"):
            gaussians.save(tmp_path / name)
    assert [item.suffix for item in FORMATS if item.write is None] == [".sog", ".ksplat"]


@pytest.mark.parametrize("degree", range(5))
def test_turning(degree: int) -> None:
    """A turned scene looks the same to a turned camera."""
    gaussians = make(40, degree)
    gaussians.means.data *= 0.1
    gaussians.log_scales.data += 1
    angle = torch.tensor([0.3, -1.1, 2.0], dtype=torch.float64)
    rotation = torch.linalg.matrix_exp(torch.tensor([[0, -angle[2], angle[1]], [angle[2], 0, -angle[0]], [-angle[1], angle[0], 0]]))
    cameras = [tsplat.Camera.look_at((0.0, -1.0, -2.2), (0.0, 0.0, 0.0), width=40, height=30, fov=50)]
    for turn in (rotation.numpy(), UP_AND_BACK):
        matrix = torch.eye(4)
        matrix[:3, :3] = torch.from_numpy(turn).float()
        camera = tsplat.Camera(cameras[0].viewmats @ matrix.T, cameras[0].Ks, 40, 30)
        turned = Fields.of("", gaussians, 4).turned(turn).gaussians()
        images = [tsplat.rasterize(g.means, g.quats, g.scales, g.opacities, g.sh, c, sh_degree=degree).image
                  for g, c in ((gaussians, cameras[0]), (turned, camera))]
        assert float((images[0] - images[1]).detach().abs().max()) < 2e-5    # float32: angles of 1e-7 times slopes of sums of coefficients
        assert float(images[0].detach().std()) > 0.05


def test_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make(300, 1).save(tmp_path / "a.ply")
    names = ["a.ply", "new folder/ä.compressed.ply", "b.spz", "c.glb", "d.splat"]
    for source, target in itertools.pairwise(names):
        assert main(["convert", str(tmp_path / source), str(tmp_path / target)]) == 0
        printed = capsys.readouterr()
        assert printed.out == f"300 splats: {tmp_path / target} ({(tmp_path / target).stat().st_size} bytes)\n"
        assert ("up to degree 0; those beyond are left out" in printed.err) == (target == "d.splat")
        assert main(["info", str(tmp_path / target)]) == 0
        lines = capsys.readouterr().out.splitlines()
        assert lines[:2] == [f"format   {find_format(tmp_path / target).name}",
                             f"splats   300, spherical harmonics of degree {0 if target == 'd.splat' else 1}"]
        assert [line.split()[0] for line in lines[3:]] == ["x", "y", "z", "opacity", "scale"]
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "a.sog")]) == 2
    assert capsys.readouterr().err.startswith(f"tsplat: error: {tmp_path / 'a.sog'}: expected a file name that ends in .ply")


# --- real files -------------------------------------------------------------------------------------------------------------------------

def payload(path: Path) -> list[np.ndarray]:
    """The arrays of an .spz file of version 3, by rows."""
    data = zlib.decompress(path.read_bytes(), 31)
    n, degree = struct.unpack("<IB", data[8:13])
    sizes = [9, 1, 3, 3, 4, 3 * ((degree + 1) ** 2 - 1)]
    ends = 16 + n * np.cumsum([0, *sizes])
    assert ends[-1] == len(data)
    return [np.frombuffer(data[a:b], np.uint8).reshape(n, -1).astype(int) for a, b in itertools.pairwise(ends)]


@pytest.fixture(scope="module")
def playbot(data_root: Path) -> Gaussians:
    return Gaussians.load(data_root / "splats" / "playbot_lod3_31k.ply")


@pytest.mark.parametrize("version", [3, 4])
def test_real_spz(data_root: Path, playbot: Gaussians, version: int) -> None:
    if version == 4:
        pytest.importorskip("zstandard", reason=".spz of version 4 needs zstandard: pip install 'tsplat[spz]'")
    loaded = Gaussians.load(data_root / "splats" / f"playbot_lod3_31k.v{version}.spz")
    clamped = Gaussians(playbot.means, playbot.quats, playbot.log_scales, playbot.opacity_logits, playbot.sh0.clamp(-0.5 / 0.15, 0.5 / 0.15),
                        playbot.sh_rest.clamp(-1, 1))
    agree(loaded, clamped, means=0.5 / 4096 + ROUNDING, log_scales=1 / 32 + ROUNDING, opacities=ROUNDING, sh0=STEP / 0.15 + ROUNDING,
          sh_rest=8.5 / 128 + ROUNDING, quats=3 * 0.5 / 511 / math.sqrt(2) + ROUNDING)
    assert psnr(draw(loaded), draw(playbot)) > 42                   # 42.6; colours and coefficients beyond the codes are clamped


def test_spz_is_written_as_others_do(data_root: Path, playbot: Gaussians, tmp_path: Path) -> None:
    """Byte for byte what splat-transform made of the same .ply, but for ties when rounding."""
    playbot.save(tmp_path / "a.spz")
    for ours, theirs in zip(payload(tmp_path / "a.spz"), payload(data_root / "splats" / "playbot_lod3_31k.v3.spz"), strict=True):
        assert (ours != theirs).sum() <= 11
        assert abs(ours - theirs).max(initial=0) <= 1


def test_real_sog(data_root: Path, playbot: Gaussians) -> None:
    for path in ("playbot_lod3_31k_sog", "playbot_lod3_31k_sog/meta.json"):          # the .ply was made of it
        loaded = Gaussians.load(data_root / "splats" / path)
        agree(loaded, playbot, means=0, log_scales=0, opacities=ROUNDING, sh0=0, sh_rest=0, quats=ROUNDING)
    assert psnr(draw(loaded), draw(playbot)) > 120
    massa, twin = (Gaussians.load(data_root / "splats" / f"massa{suffix}") for suffix in (".sog", ".ply"))
    agree(massa, twin, means=0, log_scales=0, opacities=ROUNDING, sh0=0, sh_rest=0, quats=ROUNDING)
    assert massa.opacity_logits.max() == MAX_LOGIT
    assert psnr(draw(massa, (0, -0.6, 0)), draw(twin, (0, -0.6, 0))) > 120


def test_real_compressed_ply(data_root: Path, playbot: Gaussians) -> None:
    """It has no twin, but is a finer version of the same robot; some rows are decoded by the description of the format."""
    path = data_root / "splats" / "playbot_lod2_125k.compressed.ply"
    loaded = Gaussians.load(path)
    assert (len(loaded), loaded.sh_degree) == (125_000, 2)
    data = path.read_bytes()
    start = data.index(b"end_header\n") + len(b"end_header\n")
    for i in (0, 255, 256, 77_777, 124_999):
        x0, y0, z0, x1, y1, z1, a0, b0, c0, a1, b1, c1, r0, g0, h0, r1, g1, h1 = struct.unpack_from("<18f", data, start + 72 * (i // 256))
        position, rotation, scale, color = struct.unpack_from("<4I", data, start + 72 * 489 + 16 * i)
        codes = struct.unpack_from("24B", data, start + 72 * 489 + 16 * 125_000 + 24 * i)

        def between(low: float, high: float, code: int, bits: int) -> float:
            part = (code & (1 << bits) - 1) / ((1 << bits) - 1)
            return low + (high - low) * part

        mean = [between(x0, x1, position >> 21, 11), between(y0, y1, position >> 11, 10), between(z0, z1, position, 11)]
        scales = [between(a0, a1, scale >> 21, 11), between(b0, b1, scale >> 11, 10), between(c0, c1, scale, 11)]
        dc = [(between(low, high, color >> shift, 8) - 0.5) / 0.28209479 for low, high, shift in ((r0, r1, 24), (g0, g1, 16), (h0, h1, 8))]
        quat = [between(-1, 1, rotation >> shift, 10) / math.sqrt(2) for shift in (20, 10, 0)]
        quat.insert(rotation >> 30, math.sqrt(1 - sum(v * v for v in quat)))
        rest = [8 * ({0: 0.0, 255: 1.0}.get(code, (code + 0.5) / 256) - 0.5) for code in codes]
        for values, parameter in ((mean, loaded.means), (scales, loaded.log_scales), (dc, loaded.sh0), (quat, loaded.quats)):
            assert parameter[i].flatten().tolist() == pytest.approx(values, abs=ROUNDING)
        assert loaded.sh_rest[i].T.flatten().tolist() == pytest.approx(rest, abs=ROUNDING)
        assert loaded.opacities[i].item() == pytest.approx((color & 255) / 255, abs=ROUNDING)
    assert psnr(draw(loaded), draw(playbot)) > 24                   # 25.3: four times the splats


@pytest.mark.parametrize("write", [pytest.param(lambda g, p: g.save(p), id=name) for name in ("a.splat", "a.spz", "a.glb", "a.compressed.ply")])
def test_rewritten_files_look_the_same(playbot: Gaussians, tmp_path: Path, write: Callable[[Gaussians, Path], None],
                                       request: pytest.FixtureRequest) -> None:
    name = request.node.callspec.id
    degree = 0 if name == "a.splat" else 2
    gaussians = Gaussians(playbot.means, playbot.quats, playbot.log_scales, playbot.opacity_logits, playbot.sh0,
                          playbot.sh_rest[:, :(degree + 1) ** 2 - 1])
    write(gaussians, tmp_path / name)
    bound = {"a.splat": 35, "a.spz": 42, "a.glb": 100, "a.compressed.ply": 48}[name]
    assert psnr(draw(Gaussians.load(tmp_path / name)), draw(gaussians)) > bound


def test_small_fixtures(data_root: Path) -> None:
    """Four splats at the corners of a square, written by other programs; those of .spz have y up and look back."""
    folder = data_root / "splats" / "fixtures"
    loaded = {name: Gaussians.load(folder / name) for name in ("minimal-raw.spz", "minimal-v2.spz", "minimal-v3.spz", "minimal.splat",
                                                         "minimal.ksplat")}
    for name, gaussians in loaded.items():
        back = 1.0 if name in ("minimal-raw.spz", "minimal-v2.spz") else -1.0
        assert gaussians.means.tolist() == [[-1, 0, back], [0, 0, back], [-1, 0, 0], [0, 0, 0]], name
        torch.testing.assert_close(gaussians.opacities, torch.full((4,), 230 / 255))
        assert float((gaussians.log_scales - math.log(0.1)).detach().abs().max()) <= 1 / 32
        assert float(draw(gaussians).std()) > 0.01
    assert differences(loaded["minimal-raw.spz"], loaded["minimal-v2.spz"]) == dict.fromkeys(differences(*[loaded["minimal.splat"]] * 2), 0.0)
    assert torch.equal(loaded["minimal.ksplat"].sh0, loaded["minimal.splat"].sh0)
    assert torch.equal(loaded["minimal.ksplat"].opacity_logits, loaded["minimal.splat"].opacity_logits)
    assert differences(loaded["minimal-v3.spz"], loaded["minimal.splat"])["sh0"] <= STEP / 0.15 + STEP / SH_C0 + ROUNDING


def test_small_fixture_of_version_4(data_root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    folder = data_root / "splats" / "fixtures"
    pytest.importorskip("zstandard", reason=".spz of version 4 needs zstandard: pip install 'tsplat[spz]'")
    old, new = (Gaussians.load(folder / f"minimal-v{version}.spz") for version in (3, 4))
    assert differences(old, new) == dict.fromkeys(differences(old, old), 0.0)
    monkeypatch.setitem(sys.modules, "zstandard", None)
    with pytest.raises(ImportError, match=r"minimal-v4\.spz: an \.spz file of version 4 needs the package zstandard: pip install 'tsplat\[spz\]'"):
        Gaussians.load(folder / "minimal-v4.spz")
    assert main(["info", str(folder / "minimal-v4.spz")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_glb_fixture(data_root: Path) -> None:
    """One splat per node and type of number; of a draft of the extension, with logarithms of scales. glTF has x left, y up."""
    with pytest.warns(UserWarning, match="colours in linear space"):
        gaussians = Gaussians.load(data_root / "splats" / "fixtures" / "khr_conformance_matrix.glb")
    assert (len(gaussians), gaussians.sh_degree) == (15, 3)
    assert gaussians.means.tolist() == [[-1, -2, 3]] * 15
    torch.testing.assert_close(gaussians.quats.abs(), torch.tensor([[0.0, 1, 0, 0]]).repeat(15, 1))
    expected = [[0, 0.5, -0.5]] * 3 + [[0.2, -0.1, 0.7], [1, -2, 3], [1, 0, -1], [2, -3, 4], [1, 0, -1]] + [[0, 0.5, -0.5]] * 7
    torch.testing.assert_close(gaussians.log_scales.detach(), torch.tensor(expected))
    opacities = torch.full((15,), 0.25)
    opacities[8:11] = torch.tensor([0.75, 64 / 255, 16384 / 65535])
    torch.testing.assert_close(gaussians.opacities.detach(), opacities)
    assert gaussians.sh0[3, 0, 2].item() == pytest.approx(0.3)
    signs = torch.tensor([-1.0, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1])      # of x and y: those of odd order
    file = data_root / "splats" / "fixtures" / "khr_conformance_matrix.glb"
    data = file.read_bytes()
    size, = struct.unpack("<I", data[12:16])
    document = json.loads(data[20:20 + size])
    attributes = document["meshes"][14]["primitives"][0]["attributes"]
    rows = []
    for degree in (1, 2, 3):
        for i in range(2 * degree + 1):
            view = document["bufferViews"][document["accessors"][attributes[f"KHR_gaussian_splatting:SH_DEGREE_{degree}_COEF_{i}"]]["bufferView"]]
            rows.append(struct.unpack_from("<3f", data, 28 + size + view["byteOffset"]))
    torch.testing.assert_close(gaussians.sh_rest[14].detach(), torch.tensor(rows) * signs[:, None])
    assert float(draw(gaussians, (-1.0, -2.0, 3.0)).std()) > 0.01
