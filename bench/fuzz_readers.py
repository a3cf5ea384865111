"""Mutated files for all readers of Gaussians: none may crash, hang, take much memory or give anything but a one-line ValueError.

    python bench/fuzz_readers.py                       # 100,000 mutated files for each reader
    python bench/fuzz_readers.py --files 1000 --format .spz

Small valid files are taken apart down to what they compress or nest (gzip, zstd, zip, WebP, JSON), bytes, numbers and JSON values in them are
changed, and they are put together again, so that most mutations get past checksums. Each reader runs in a process of its own whose address space
may grow by 64 MiB (files have a few kB) and in which a file may take 5 seconds. Readers that pass print a row; a file that fails is kept.
"""

from __future__ import annotations

import argparse
import copy
import io
import itertools
import json
import random
import re
import resource
import signal
import struct
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from tsplat.scene import Gaussians
from tsplat.scene.formats import find_format

sys.path.append(str(Path(__file__).resolve().parent))               # tests import this file from elsewhere
from output import peak_memory

MEMORY = 64 << 20               # bytes by which the address space may grow
SECONDS = 5
INTERESTING = (0, 1, 2, 3, 4, 16, 127, 128, 255, 256, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF,
               (1 << 63) - 1, 1 << 63, (1 << 64) - 1)
NUMBERS = ("-1", "0", "1", "7", "1e999", "4294967296", "9" * 30, "9" * 5000, "0.5", "NaN", "-Infinity")
VALUES = (None, True, -1, 0, 1, 3, 1 << 40, 10 ** 40, -0.5, 1e308, float("nan"), "", "..", "meta.json", "sh0.webp", "VEC3", [], [0], {}, {"a": 1})

Parts = tuple[bytes, ...]


@dataclass(frozen=True)
class Sample:
    """A valid file, taken apart: `join(parts)` is its bytes."""

    name: str
    parts: Parts
    join: Callable[[Parts], bytes]

    @property
    def data(self) -> bytes:
        """The valid file."""
        return self.join(self.parts)


def scene(n: int = 6, degree: int = 1) -> Gaussians:
    """A few random Gaussians."""
    generator = torch.Generator().manual_seed(n + degree)
    shapes = ((n, 3), (n, 4), (n, 3), (n,), (n, 1, 3), (n, (degree + 1) ** 2 - 1, 3))
    return Gaussians(*(torch.randn(shape, generator=generator) / 4 for shape in shapes))


def samples() -> list[Sample]:
    """Valid files of all formats; those of .spz version 4 only where zstandard is installed."""
    found = [Sample(name, (_saved(scene(degree=degree), name),), b"".join)
             for name, degree in (("a.ply", 1), ("b.compressed.ply", 1), ("c.compressed.ply", 0), ("d.splat", 0))]
    spz = [zlib.decompress(_saved(scene(degree=degree), "a.spz", **options), 31) for degree, options in ((1, {}), (0, {"version": 2}))]
    found += [Sample("e.spz", (data,), _gzip) for data in spz]
    found += [Sample("f.spz", (_gzip((spz[0],)),), b"".join), Sample("g.spz", (spz[1],), b"".join)]
    try:
        header, *arrays = _version_4(spz[0])
        found += [Sample("h.spz", (header, *arrays), _frames), Sample("i.spz", (_frames((header, *arrays)),), b"".join)]
    except ImportError:
        pass
    glb = _saved(scene(), "a.glb")
    size, = struct.unpack("<I", glb[12:16])
    found += [Sample("j.glb", (glb[20:20 + size], glb[28 + size:]), _chunks), Sample("k.glb", (glb,), b"".join)]
    files = sog(n=6)
    found += [Sample("l.sog", tuple(files.values()), lambda parts: zipped(dict(zip(files, parts, strict=True)))),
              Sample("m.sog", (zipped(files, zipfile.ZIP_DEFLATED),), b"".join)]
    found += [Sample(f"{name}.ksplat", ksplat(level), b"".join) for level, name in enumerate("nop")]
    return found


def _saved(gaussians: Gaussians, name: str, **options: int) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        write = find_format(path, writing=True).write
        assert write is not None
        write(path, gaussians, **options)
        return path.read_bytes()


def _gzip(parts: Parts) -> bytes:
    stream = zlib.compressobj(1, wbits=31)
    return stream.compress(parts[0]) + stream.flush()


def _version_4(spz: bytes) -> Parts:
    """The header and the arrays of a file of version 3, as version 4 has them."""
    import zstandard  # noqa: F401, without it there is no version 4

    _, _, n, degree, bits, flags, _ = struct.unpack("<4sIIBBBB", spz[:16])
    sizes = [size for size in (9 * n, n, 3 * n, 3 * n, 4 * n, 3 * n * ((degree + 1) ** 2 - 1)) if size]
    ends = np.cumsum([16, *sizes])
    header = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, n, degree, bits, flags, len(sizes), 32)
    return header, *(spz[a:b] for a, b in itertools.pairwise(ends))


def _frames(parts: Parts) -> bytes:
    import zstandard

    frames = [zstandard.ZstdCompressor(level=1).compress(part) for part in parts[1:]]
    table = b"".join(struct.pack("<QQ", len(frame), len(part)) for frame, part in zip(frames, parts[1:], strict=True))
    return parts[0] + table + b"".join(frames)


def _chunks(parts: Parts) -> bytes:
    text = parts[0] + b" " * (-len(parts[0]) % 4)
    return (struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(parts[1])) + struct.pack("<I4s", len(text), b"JSON") + text
            + struct.pack("<I4s", len(parts[1]), b"BIN\0") + parts[1])


def ksplat(level: int, degree: int = 1, seed: int = 0) -> Parts:
    """The header, that of the one section, its buckets (one of 4 splats, one of 2) and its rows."""
    rng = np.random.default_rng(seed)
    n, rest = 6, 3 * ((degree + 1) ** 2 - 1)
    header = struct.pack("<BB2xIIIIH14xff4052x", 0, 1, 1, 1, n, n, level, -1.0, 2.0)
    section = struct.pack("<IIIIfH2xIIIIH982x", n, n, 4, 2, 5.0, 12, 32767, 0, 1, 1, degree)
    buckets = struct.pack("<I6f", 2, *rng.normal(size=6))
    floats = "<f2" if level else "<f4"
    means = rng.integers(0, 65535, (n, 3)).astype("<u2") if level else rng.normal(size=(n, 3)).astype("<f4")
    coefficients = rng.integers(0, 255, (n, rest)).astype("u1") if level == 2 else rng.normal(size=(n, rest)).astype(floats)
    columns = (means, rng.random((n, 3)).astype(floats), rng.normal(size=(n, 4)).astype(floats), rng.integers(0, 255, (n, 4)).astype("u1"),
               coefficients)
    return header, section, buckets, b"".join(column[i].tobytes() for i in range(n) for column in columns)


def zipped(files: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    """A zip of these files."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return file.getvalue()


def sog(n: int = 6, degree: int = 1, seed: int = 0) -> dict[str, bytes]:
    """The files of a random scene in SOG, by name."""
    rng = np.random.default_rng(seed)

    def image(width: int, height: int, *, largest: int = 255, alpha: tuple[int, int] = (255, 255)) -> bytes:
        pixels = rng.integers(0, largest, (height, width, 4), endpoint=True)
        pixels[..., 3] = rng.integers(*alpha, (height, width), endpoint=True)
        return webp(pixels.astype(np.uint8))

    rest = (degree + 1) ** 2 - 1
    meta = {"version": 2, "count": n, "means": {"mins": [-1, -1, -1], "maxs": [1, 0.5, 1], "files": ["means_l.webp", "means_u.webp"]},
            "scales": {"codebook": np.linspace(-8, -1, 256).round(3).tolist(), "files": ["scales.webp"]}, "quats": {"files": ["quats.webp"]},
            "sh0": {"codebook": np.linspace(-1.5, 2, 256).round(3).tolist(), "files": ["sh0.webp"]}}
    if degree:
        meta["shN"] = {"count": 64, "bands": degree, "codebook": np.linspace(-1, 1, 256).round(3).tolist(),
                       "files": ["shN_centroids.webp", "shN_labels.webp"]}
    side = -(-n // 4)
    files = {"meta.json": json.dumps(meta).encode(), "means_l.webp": image(4, side), "means_u.webp": image(4, side),
             "quats.webp": image(4, side, alpha=(252, 255)), "scales.webp": image(4, side), "sh0.webp": image(4, side, alpha=(0, 255))}
    if degree:
        labels = np.zeros((side, 4, 4), np.uint8)
        labels[..., 0], labels[..., 3] = rng.integers(0, 64, (side, 4)), 255
        files |= {"shN_centroids.webp": image(64 * rest, 1), "shN_labels.webp": webp(labels)}
    return files


def webp(pixels: np.ndarray) -> bytes:
    """A lossless WebP image of `[H, W, 4]` uint8 RGBA: no transforms, and codes of 8 bits for all bytes."""
    height, width = pixels.shape[:2]
    bits: list[int] = []

    def put(value: int, count: int) -> None:
        bits.extend(value >> i & 1 for i in range(count))

    put(width - 1, 14)
    put(height - 1, 14)
    put(1, 1)                                                     # alpha is used
    put(0, 3 + 1 + 1 + 1)                                         # version, no transforms, no cache of colours, one group of codes
    for channel in range(4):                                      # green, red, blue, alpha
        put(0, 1)                                                 # the lengths of codes are themselves coded,
        put(8, 4)                                                 # by 12 lengths of 3 bits, of which only the last, for length 8, is not 0
        put(1 << 33, 36)
        put(*((1 | 3 << 1 | 254 << 4, 12) if channel == 0 else (0, 1)))        # 256 symbols of green, whose alphabet is larger; else all
    put(1, 1 + 1 + 1 + 1)                                         # distances: one symbol, 0, of 1 bit
    reversed_bits = np.array([int(f"{i:08b}"[::-1], 2) for i in range(256)], np.uint8)
    codes = np.unpackbits(reversed_bits[pixels[..., [1, 0, 2, 3]]].reshape(-1, 1), axis=1, bitorder="little").reshape(-1)
    data = b"\x2f" + np.packbits(np.concatenate([np.array(bits, np.uint8), codes]), bitorder="little").tobytes()
    data += bytes(len(data) % 2)
    return struct.pack("<4sI4s4sI", b"RIFF", len(data) + 12, b"WEBP", b"VP8L", len(data)) + data


def mutated(sample: Sample, rng: random.Random) -> bytes:
    """The file with one to four changes."""
    parts = list(sample.parts)
    for _ in range(rng.choice((1, 1, 2, 4))):
        i = rng.randrange(len(parts))
        parts[i] = _changed(parts[i], rng)
    return sample.join(tuple(parts))


def _changed(data: bytes, rng: random.Random) -> bytes:
    a, b = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    c = rng.randrange(len(data) + 1)
    b = min(b, a + rng.choice((1, 4, 64, 4096)))
    match rng.randrange(9):
        case 0 if data:                                           # a bit
            i = rng.randrange(len(data))
            return data[:i] + bytes([data[i] ^ 1 << rng.randrange(8)]) + data[i + 1:]
        case 1:                                                   # a number that is special, in the first bytes as often as elsewhere
            width = rng.choice((1, 2, 4, 8))
            a = rng.choice((a, rng.randrange(64)))
            return data[:a] + (rng.choice(INTERESTING) % (1 << 8 * width)).to_bytes(width, "little") + data[a + width:]
        case 2:
            return data[:a] + data[b:]
        case 3:
            return data[:a] + data[a:b] * 2 + data[b:]
        case 4:
            return data[:c] + data[a:b] + data[c:]
        case 5:
            return data[:a] if rng.random() < 0.5 else data + rng.randbytes(rng.choice((1, 8, 300)))
        case 6:
            return data[:a] + rng.randbytes(b - a) + data[b:]
        case 7 if numbers := list(re.finditer(rb"-?\d+(\.\d+)?", data)):
            found = rng.choice(numbers[:200])
            return data[:found.start()] + rng.choice(NUMBERS).encode() + data[found.end():]
        case 8 if data[:1] == b"{":
            try:
                document = json.loads(data)
            except (ValueError, RecursionError):
                return data
            _change_json(document, rng)
            return json.dumps(document).encode()
    return data


def _change_json(document: object, rng: random.Random) -> None:
    places: list[tuple[dict | list, object]] = []
    waiting = [document]
    while waiting:
        value = waiting.pop()
        if isinstance(value, dict | list):
            keys: Sequence = list(value) if isinstance(value, dict) else range(min(len(value), 40))
            places += [(value, key) for key in keys]
            waiting += [value[key] for key in keys]
    if places:
        container, key = rng.choice(places)
        match rng.randrange(3):
            case 0:
                container[key] = rng.choice(VALUES)
            case 1:
                other, place = rng.choice(places)
                container[key] = copy.deepcopy(other[place])
            case 2:
                del container[key]


def check(path: Path, data: bytes) -> bool:
    """Read these bytes as a file of this name; whether they were taken. Everything but a one-line ValueError of the file is raised."""
    path.write_bytes(data)
    try:
        gaussians = Gaussians.load(path)
    except ValueError as error:
        if not str(error).startswith(f"{path}: ") or "\n" in str(error) or len(str(error)) > 1000:
            raise RuntimeError(f"expected one line that begins with {path}; got {str(error)[:2000]!r}") from error
        return False
    assert all(parameter.dtype == torch.float32 for parameter in gaussians.parameters())
    return True


def run(sample: Sample, index: int, files: int) -> None:
    """Check so many mutations of a sample within bounds of memory and time; print a row."""
    torch.set_num_threads(1)
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        tempfile.tempdir = folder                                 # also for what readers unpack
        path = Path(folder) / sample.name
        assert check(path, sample.data), "the valid file is refused"
        before = peak_memory()
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY,) * 2)
        signal.signal(signal.SIGALRM, _too_slow)
        taken, slowest, start = 0, 0.0, time.perf_counter()
        for i in range(files):
            data = mutated(sample, random.Random(1_000_003 * index + i))
            began = time.perf_counter()
            signal.alarm(SECONDS)
            try:
                taken += check(path, data)
            except BaseException:                                 # also what a decoder's panic raises
                kept = Path(__file__).parent / f"failed_{i}_{sample.name}"
                kept.write_bytes(data)
                print(f"file {i} failed; it is kept as {kept}", file=sys.stderr)
                raise
            signal.alarm(0)
            slowest = max(slowest, time.perf_counter() - began)
        grown = (peak_memory() - before) / 2**20
        print(f"| {index} {sample.name} | {len(sample.data)} | {files} | {taken} | {slowest * 1e3:.0f} | {grown:.1f} | "
              f"{time.perf_counter() - start:.0f} |", flush=True)


def _too_slow(*_: object) -> None:
    raise TimeoutError(f"took more than {SECONDS} seconds")


def main() -> int:
    """Run all samples in processes of their own; 1 if one fails."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--files", type=int, default=100_000, help="mutated files for each format, shared by its samples (default: 100,000)")
    parser.add_argument("--format", default="", help="only formats with this suffix")
    parser.add_argument("--sample", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    everything = samples()
    suffixes = [sample.name[1:] for sample in everything]
    if options.sample is not None:
        try:
            run(everything[options.sample], options.sample, options.files)
        except BaseException:
            traceback.print_exc()
            return 1
        return 0
    print("| sample | bytes | mutated files | taken | slowest ms | memory grown by MiB | seconds |\n" + "| --- " * 7 + "|", flush=True)
    failed = 0
    for i, suffix in enumerate(suffixes):
        if suffix.endswith(options.format):
            files = -(-options.files // suffixes.count(suffix))
            code = subprocess.run([sys.executable, __file__, "--sample", str(i), "--files", str(files)]).returncode
            if code:
                print(f"sample {i}, {everything[i].name}: exit status {code}", file=sys.stderr)
            failed += code != 0
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
