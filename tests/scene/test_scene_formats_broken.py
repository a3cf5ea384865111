"""Broken, lying and hostile files: every one gives one line that names it, and none takes memory that its size does not explain."""

import json
import random
import struct
import tempfile
import tracemalloc
import warnings
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.fuzz_readers import Sample, check, ksplat, mutated, samples, scene, sog, webp, zipped
from tsplat.scene import Gaussians
from tsplat.scene.formats import is_sog
from tsplat.scene.gaussians import SH_C0
from tsplat.scene.ply_table import read_header

SAMPLES = samples()
SMALL = [sample for sample in SAMPLES if sample.name not in ("m.sog", "l.sog")]
MEMORY = 1 << 20                    # bytes, of which 64 kB are for reading zips


def refused(path: Path, data: bytes, match: str) -> None:
    path.write_bytes(data)
    with pytest.raises(ValueError, match=match) as caught:
        Gaussians.load(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def peak(run: Callable[[], None]) -> int:
    """Bytes that were held at once while running."""
    tracemalloc.start()
    try:
        run()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def spz(count: int, version: int = 3, degree: int = 0, bits: int = 12, flags: int = 0, body: bytes | None = None) -> bytes:
    body = bytes(count * (19 if version == 2 else 20)) if body is None else body
    return struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, bits, flags, 0) + body


def packed(data: bytes) -> bytes:
    stream = zlib.compressobj(wbits=31)
    return stream.compress(data) + stream.flush()


@pytest.mark.parametrize("sample", SAMPLES, ids=lambda sample: sample.name)
@settings(max_examples=40, deadline=None)
@given(rng=st.randoms(use_true_random=False))
def test_mutations(sample: Sample, rng: random.Random) -> None:
    """As `bench/fuzz_readers.py`, which does this 100,000 times for each format."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check(Path(folder) / sample.name, mutated(sample, rng))


@pytest.mark.parametrize("sample", SMALL, ids=lambda sample: sample.name)
def test_every_truncation(sample: Sample, tmp_path: Path) -> None:
    data = sample.data
    for size in [*range(min(len(data), 64)), *range(64, len(data), max(1, len(data) // 128)), len(data) - 1]:
        assert check(tmp_path / sample.name, data[:size]) == (sample.name == "d.splat" and size % 32 == 0), size


@pytest.mark.parametrize("sample", SMALL, ids=lambda sample: sample.name)
def test_longer_than_announced(sample: Sample, tmp_path: Path) -> None:
    assert check(tmp_path / sample.name, sample.data)
    refused(tmp_path / sample.name, sample.data + b"x", "oversized|its header says|a multiple of 32")


@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply", "a.spz", "a.glb", "a.sog"])
def test_foreign_files(tmp_path: Path, name: str) -> None:
    refused(tmp_path / name, b"", "expected|truncated")
    refused(tmp_path / name, b"\x89PNG\r\n\x1a\n" + bytes(100), "expected")


@pytest.mark.parametrize("name", ["a.spz", "a.splat", "a.glb", "a.compressed.ply"])
def test_full_disk_leaves_the_old_file(tmp_path: Path, name: str) -> None:
    resource = pytest.importorskip("resource", reason="needs POSIX file size limits")
    scene(3, degree=0).save(tmp_path / name)
    before = (tmp_path / name).read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2048, limits[1]))
    try:
        with pytest.raises(OSError, match=r"large|space"):
            scene(2000, degree=0).save(tmp_path / name)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert (tmp_path / name).read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_spz_refusals(tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    assert check(path, packed(spz(4)))
    refused(path, packed(spz(4, version=1)), "at byte 4: expected .spz version 2, 3 or 4; got 1")
    refused(path, packed(spz(4, version=4)), "at byte 4: expected version 2 or 3 in gzip; got 4")
    refused(path, packed(spz(4, degree=5)), "at byte 12: expected spherical harmonics of degree 0 to 4; got 5")
    refused(path, packed(spz(4, bits=25)), "at byte 13: expected at most 24 fractional bits")
    refused(path, packed(b"XX" + spz(4)), "at byte 0: expected an .spz file")
    refused(path, packed(spz(4)[:-1]), "at byte 95: truncated: expected 80 bytes for 4 splats; found 79")
    refused(path, packed(spz(4) + b"x"), "expected 96 bytes in gzip for 4 splats; found more")
    refused(path, packed(spz(4)) + b"x", "oversized: expected the end of the file after its gzip stream")
    refused(path, packed(spz(4))[:-4], "found no end")
    refused(path, packed(spz(4))[:-4] + b"1234", "expected gzip; .*incorrect length check")
    refused(path, spz(4) + b"x", "at byte 96: oversized")
    with pytest.warns(UserWarning, match="extensions are not known"):
        assert check(path, packed(spz(4, flags=2) + b"record"))
    with pytest.warns(UserWarning, match="extensions are not known"):
        refused(path, packed(spz(4, flags=2) + bytes(1 << 17)), "found more")
    with pytest.warns(UserWarning, match="antialiasing"):
        assert check(path, packed(spz(4, flags=1)))


def test_spz_bombs(tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    many = packed(spz((1 << 32) - 1, body=b""))
    reason = "at byte 8: expected at most 1032 times the file's .* bytes; its number of splats needs 85899345900"
    assert peak(lambda: refused(path, many, reason)) < MEMORY
    zeros = packed(spz(4) + bytes(50 << 20))
    assert peak(lambda: refused(path, zeros, "found more")) < MEMORY


def test_spz_frames(tmp_path: Path) -> None:
    zstandard = pytest.importorskip("zstandard", reason=".spz of version 4 needs zstandard: pip install 'tsplat[spz]'")
    path = tmp_path / "a.spz"
    sizes = (36, 4, 12, 12, 16)

    def made(frames: list[bytes], announced: tuple[int, ...] = sizes, count: int = 4, table: int = 32, number: int = 5) -> bytes:
        header = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, 0, 12, 0, number, table)
        return header + b"".join(struct.pack("<QQ", len(f), n) for f, n in zip(frames, announced, strict=True)) + b"".join(frames)

    compress = zstandard.ZstdCompressor().compress
    frames = [compress(bytes(size)) for size in sizes]
    assert check(path, made(frames))
    streamed = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(36))
    assert check(path, made([streamed, *frames[1:]]))
    refused(path, made(frames, number=6), "at byte 15: expected 5 zstd frames for degree 0; got 6")
    refused(path, made(frames, table=31), "at byte 16: expected the table of sizes behind the header of 32 bytes; got 31")
    refused(path, made(frames, table=1 << 31), "at byte 32: truncated")
    refused(path, made(frames, (36, 4, 12, 12, 17)), "expected a zstd frame of 16 bytes for 4 splats; the table says 17")
    refused(path, made([*frames[:4], compress(bytes(17))]), "expected 16 bytes in a zstd frame for 4 splats; found 17")
    refused(path, made([*frames[:4], compress(bytes(15))]), "expected 16 bytes in a zstd frame for 4 splats; found 15")
    refused(path, made([*frames[:4], b"no zstd at all"]), "expected a zstd frame; ")
    refused(path, made(frames) + b"x", "oversized")
    bomb = made([*frames[:4], compress(bytes(50 << 20))])
    assert peak(lambda: refused(path, bomb, "expected 16 bytes in a zstd frame for 4 splats; found 17")) < MEMORY
    many = made(frames, tuple(size << 28 for size in sizes), count=1 << 30)
    assert peak(lambda: refused(path, many, "its number of splats needs 21474836480")) < MEMORY


def test_compressed_ply_refusals(tmp_path: Path) -> None:
    path = tmp_path / "a.compressed.ply"
    scene(300).save(path)
    whole = path.read_bytes()
    size = read_header(path).size
    for old, new, match in ((b"element chunk 2", b"element chunk 1", "2 chunks for 300 splats; got 1"),
                            (b"element vertex 300", b"element vertex 999", "4 chunks for 999 splats"),
                            (b"element sh 300", b"element sh 299", "300 rows of f_rest_0, .* got 299 of 9 columns"),
                            (b"property uchar f_rest_8\n", b"", "got 300 of 8 columns"),
                            (b"uchar f_rest_8", b"ushort f_rest_8", "f_rest_1, ... of type uchar"),
                            (b"uint packed_color", b"uint packed", "the columns packed_position, .* got packed_position"),
                            (b"uint packed_color", b"int packed_color", "of type uint"),
                            (b"float max_b", b"float max_c", "the bounds min_x, .* got min_x"),
                            (b"binary_little_endian", b"binary_big_endian", "got binary_big_endian")):
        assert old in whole
        refused(path, whole.replace(old, new), match)
    refused(path, whole[:-1], f"truncated: expected {len(whole)} bytes for 2 rows of `chunk`; found {len(whole) - 1}")
    refused(path, whole + b"x", f"at byte {len(whole)}: oversized")
    many = whole.replace(b"element chunk 2", b"element chunk 3906250000").replace(b" 300\n", b" 1000000000000\n")
    assert peak(lambda: refused(path, many, "truncated: expected")) < MEMORY
    old = whole[:size].replace(b"".join(f"property float {end}_{name}\n".encode() for end in ("min", "max") for name in "rgb"), b"")
    bounds = np.frombuffer(whole[size:size + 144], "<f4").reshape(2, 18)[:, :12]
    assert check(path, old + bounds.tobytes() + whole[size + 144:])                          # the first version: colours between 0 and 1


def glb(change: Callable[[dict], object]) -> bytes:
    """The sample with a changed document."""
    sample = next(sample for sample in SAMPLES if sample.name == "j.glb")
    document = json.loads(sample.parts[0])
    change(document)
    return sample.join((json.dumps(document).encode(), sample.parts[1]))


@pytest.mark.parametrize(("change", "match"), [
    (lambda d: d["accessors"][0].update(count=10 ** 12), r"accessors\[0\]: more splats than the file has room for: 1000000000000"),
    (lambda d: d["accessors"][0].update(count=7), r"accessors\[0\]: expected 7 rows of 12 bytes, 12 apart, from byte 0 of a view of 72 bytes"),
    (lambda d: d["accessors"][0].update(count=5), "as many rows in all attributes; got 5, 6"),
    (lambda d: d["accessors"][0].update(count=-1), "expected -1 rows"),
    (lambda d: d["accessors"][0].update(count="6"), r"accessors\[0\].count: expected int; got str"),
    (lambda d: d["accessors"][0].update(count=True), "expected int; got bool"),
    (lambda d: d["accessors"][0].update(byteOffset=-4), "from byte -4"),
    (lambda d: d["accessors"][0].update(type="VEC4"), "expected type VEC3; got VEC4"),
    (lambda d: d["accessors"][0].update(componentType=5125), "expected a componentType of"),
    (lambda d: d["accessors"][0].update(sparse={}), "sparse accessors are not supported"),
    (lambda d: d["bufferViews"][0].update(byteLength=10 ** 9), r"bufferViews\[0\]: expected a view within \d+ bytes; got 1000000000 at 0"),
    (lambda d: d["bufferViews"][0].update(byteOffset=-1), "expected a view within"),
    (lambda d: d["bufferViews"][0].update(byteStride=0), "0 apart"),
    (lambda d: d["bufferViews"][0].update(buffer=1), r"buffers: expected an array with an element 1"),
    (lambda d: d["buffers"][0].update(uri="x.bin"), "expected a view of buffer 0"),
    (lambda d: d["bufferViews"][0].update(extensions={"EXT_meshopt_compression": {}}), "compressed buffers are not supported; found EXT_mesh"),
    (lambda d: d["meshes"][0]["primitives"][0].update(mode=4), "expected mode 0, points; got 4"),
    (lambda d: d["meshes"][0]["primitives"][0]["attributes"].update(POSITION=99), r"attributes.POSITION: expected an index below \d+"),
    (lambda d: d["meshes"][0]["primitives"][0]["attributes"].pop("KHR_gaussian_splatting:OPACITY"), "expected an object with .*OPACITY"),
    (lambda d: d["meshes"][0]["primitives"][0].pop("extensions"), "expected a primitive with the extension KHR_gaussian_splatting"),
    (lambda d: d["nodes"].append({"children": [1]}) or d["scenes"][0].update(nodes=[0, 1]), r"nodes\[1\]: expected a tree of nodes; it occurs"),
    (lambda d: d["nodes"][0].update(scale=[1, 2, 1]), r"nodes\[0\]: expected a matrix that moves, turns and scales all axes alike"),
    (lambda d: d["nodes"][0].update(scale=[-1, -1, -1]), "sheared or mirrored"),
    (lambda d: d["nodes"][0].update(scale=[1e300] * 3), "all axes alike"),
    (lambda d: d["nodes"][0].update(rotation=[0, 0, 0]), r"nodes\[0\].rotation: expected 4 numbers"),
    (lambda d: d["nodes"][0].update(translation=[0, 0, float("nan")]), "expected finite numbers"),
    (lambda d: d["nodes"].extend([{"mesh": 0}] * 2000) or d["scenes"][0].update(nodes=list(range(2001))), "expected at most 1000 primitives"),
])
def test_glb_refusals(tmp_path: Path, change: Callable[[dict], object], match: str) -> None:
    refused(tmp_path / "a.glb", glb(change), match)


def test_glb_bombs(tmp_path: Path) -> None:
    """Splats that many nodes show: memory is a constant times the size of the file."""
    def change(document: dict) -> None:
        document["nodes"] = [{"mesh": 0}] * 900
        document["scenes"] = [{"nodes": list(range(900))}]

    few, many = (next(sample for sample in SAMPLES if sample.name == "j.glb").data, glb(change))
    assert check(tmp_path / "a.glb", few)
    assert peak(lambda: check(tmp_path / "a.glb", many)) < 200 * len(many) + MEMORY


def test_glb_nodes(tmp_path: Path) -> None:
    """Moved, turned by a quarter about y, twice as large; in a child of a moved node; without a scene."""
    path = tmp_path / "a.glb"
    half = 0.5 ** 0.5
    path.write_bytes(glb(lambda d: None))
    before = Gaussians.load(path)

    def change(document: dict) -> None:
        document["nodes"] = [{"children": [1], "translation": [1, 0, 0]}, {"mesh": 0, "rotation": [0, half, 0, half], "scale": [2, 2, 2]}]
        del document["scenes"], document["scene"]

    path.write_bytes(glb(change))
    after = Gaussians.load(path)
    x, y, z = (2 * before.means).detach().numpy().T                  # in the file (-x, -y, z): a quarter turn makes (z, -y, x) of it
    np.testing.assert_allclose(after.means.detach().numpy(), np.stack([-z - 1, y, x], axis=1), atol=1e-6)
    np.testing.assert_allclose((after.log_scales - before.log_scales).detach().numpy(), np.log(2), atol=1e-6)
    assert not np.allclose(after.sh_rest.detach().numpy(), before.sh_rest.detach().numpy())


@pytest.mark.parametrize("text", [b"[" * 100_000, b"{", b"\xff", b"[]", b"1", b'{"nodes": ' + b"9" * 5000 + b"}", b'{"nodes": 1}'])
def test_glb_documents(tmp_path: Path, text: bytes) -> None:
    sample = next(sample for sample in SAMPLES if sample.name == "j.glb")
    refused(tmp_path / "a.glb", sample.join((text, sample.parts[1])), "at byte 2[0-4]: ")


def meta(files: dict[str, bytes], **members: object) -> dict[str, bytes]:
    return files | {"meta.json": json.dumps(json.loads(files["meta.json"]) | members).encode()}


def test_sog_refusals(tmp_path: Path) -> None:
    path = tmp_path / "a.sog"
    files = sog(6)
    assert check(path, zipped(files))
    shn = json.loads(files["meta.json"])["shN"]
    for changed, match in (
            (meta(files, version=3), "expected SOG version 2; got 3"),
            (meta(files, count=10 ** 9), "expected a count of 1 to .* splats, which files of this size can hold; got 1000000000"),
            (meta(files, count=9), "means.files.0.: expected an image of 9 pixels or a few more in means_l.webp; got 4x2"),
            (meta(files, count=0), "expected a count of 1"),
            (meta(files, quats={"files": ["../quats.webp"]}), "expected the name of a file beside meta.json; got '../quats.webp'"),
            (meta(files, quats={"files": ["other.webp"]}), "expected other.webp in the zip; found meta.json, means_l.webp"),
            (meta(files, quats={"files": []}), "quats.files: expected an array with an element 0"),
            (meta(files, scales={"files": ["scales.webp"], "codebook": [1.0]}), "scales.codebook: expected 256 numbers"),
            (meta(files, shN=shn | {"bands": 4}), "shN: expected 1 to 3 bands; got 4"),
            (meta(files, shN=shn | {"bands": 2}), "expected an image 512 pixels wide in shN_centroids.webp; got 192x1"),
            (meta(files, shN=shn | {"count": 1}), "expected labels below 1, the entries of the palette"),
            (files | {"quats.webp": b"RIFF1234WEBPVP8 " + bytes(30)}, "expected a lossless WebP image in quats.webp"),
            (files | {"quats.webp": files["quats.webp"][:-30]}, "quats.webp cannot be decoded"),
            (files | {"meta.json": b"{"}, "at byte 1: expected JSON")):
        refused(path, zipped(changed), match)
    refused(path, zipped({name: data for name, data in files.items() if name != "meta.json"}), "expected meta.json in the zip")
    spoilt = zipped(files)
    refused(path, spoilt.replace(files["sh0.webp"], files["scales.webp"]), "sh0.webp cannot be unpacked; Bad CRC-32")


def test_sog_bombs(tmp_path: Path) -> None:
    path = tmp_path / "a.sog"
    files = sog(6)
    large = files["quats.webp"][:21] + struct.pack("<I", (1 << 28) - 1) + files["quats.webp"][25:]        # 16384 x 16384
    assert peak(lambda: refused(path, zipped(files | {"quats.webp": large}), "expected an image of 6 pixels .* got 16384x16384")) < 2 * MEMORY
    palette = files["shN_centroids.webp"][:21] + struct.pack("<I", 191 | 16383 << 14 | 1 << 28) + files["shN_centroids.webp"][25:]
    assert peak(lambda: refused(path, zipped(files | {"shN_centroids.webp": palette}), "pixels in shN_centroids.webp, which files of this size")
                ) < 2 * MEMORY
    bomb = zipped(files | {"meta.json": b" " * (100 << 20)}, zipfile.ZIP_DEFLATED)
    reason = "at byte 0: expected at most .* bytes in meta.json, 64 for each of the file"
    assert peak(lambda: refused(path, bomb, reason)) < 3 * 64 * len(bomb)


@pytest.mark.parametrize("level", range(3))
def test_ksplat(tmp_path: Path, level: int) -> None:
    """Row by row as the format is described; then what is refused."""
    path = tmp_path / "a.ksplat"
    header, section, buckets, rows = ksplat(level)
    assert check(path, header + section + buckets + rows)
    loaded = Gaussians.load(path)
    size = len(rows) // 6
    kind = "<3f3f4f4B9f" if level == 0 else "<3H3e4e4B9e" if level == 1 else "<3H3e4e4B9B"
    assert struct.calcsize(kind) == size
    centres = np.frombuffer(buckets[4:], "<f4").reshape(2, 3)
    for i in range(6):
        values = np.array(struct.unpack_from(kind, rows, i * size), np.float64)
        mean = values[:3] if level == 0 else (values[:3] - 32767) / 32767 * 2.5 + centres[0 if i < 4 else 1]
        rest = values[14:] if level < 2 else values[14:] / 255 * 3 - 1
        for found, expected in ((loaded.means, mean), (loaded.scales, values[3:6]), (loaded.quats, values[6:10]), (loaded.sh_rest.mT, rest)):
            np.testing.assert_allclose(found[i].detach().flatten().numpy(), expected, rtol=2e-6, atol=1e-6)
        np.testing.assert_allclose((SH_C0 * loaded.sh0[i, 0] + 0.5).detach().numpy(), values[10:13] / 255, atol=1e-6)
        assert loaded.opacities[i].item() == pytest.approx(values[13] / 255, abs=1e-6)

    def changed(data: bytes, at: int, kind: str, value: float) -> bytes:
        return data[:at] + struct.pack(kind, value) + data[at + struct.calcsize(kind):]

    for a, b, match in ((changed(header, 1, "B", 2), section, "at byte 0: expected .ksplat version 0.1; got 0.2"),
                        (changed(header, 20, "<H", 3), section, "at byte 20: expected compression level 0 to 2; got 3"),
                        (changed(header, 16, "<I", 7), section, "at byte 16: expected 7 splats, as the header says; found 6 in 1 sections"),
                        (changed(header, 4, "<I", (1 << 32) - 1), section, "truncated: expected 1024 bytes of the header of a section"),
                        (header, changed(section, 40, "<H", 3), "at byte 4136: expected spherical harmonics of degree 0 to 2; got 3"),
                        (header, changed(section, 0, "<I", 7), "at byte 4096: expected at most 6 splats"),
                        (header, changed(section, 4, "<I", 1 << 31), "truncated: expected .* bytes of splats"),
                        (header, changed(section, 12, "<I", 1 << 31), r"1 \+ 1 buckets of 12 bytes; got 6 and 2147483648"),
                        (header, changed(changed(section, 12, "<I", 1 << 31), 32, "<I", (1 << 31) - 1), "bytes of centres of buckets; found")):
        assert peak(lambda data=a + b, match=match: refused(path, data + buckets + rows, match)) < MEMORY
    if level:
        refused(path, header + section + changed(buckets, 0, "<I", 1) + rows, "at byte 4096: expected buckets for 6 splats; got them for 5")


def test_sog_folder(tmp_path: Path) -> None:
    files = sog(6, degree=2)
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    loaded = Gaussians.load(tmp_path)
    assert (len(loaded), loaded.sh_degree) == (6, 2)
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture" / "meta.json").write_text("{}")
    assert [is_sog(tmp_path), is_sog(tmp_path / "capture")] == [True, False]
    (tmp_path / "quats.webp").unlink()
    with pytest.raises(FileNotFoundError, match=r"quats\.webp"):
        Gaussians.load(tmp_path / "meta.json")


def test_webp_of_the_samples(tmp_path: Path) -> None:
    """The images made here are what other decoders take them for."""
    from tsplat.scene import read_image
    pixels = np.random.default_rng(0).integers(0, 256, (5, 7, 4)).astype(np.uint8)
    (tmp_path / "a.webp").write_bytes(webp(pixels))
    assert (read_image(tmp_path / "a.webp").numpy() == pixels).all()
