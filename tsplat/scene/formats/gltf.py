"""glTF binaries (.glb) with splats: point primitives with the extension KHR_gaussian_splatting (Khronos, ratified in 2026).

Attributes are the parameters as the renderer takes them: linear scales, opacities, quaternions xyzw, one vector of 3 per SH coefficient. Axes are x
left, y up, z front. Drafts of the extension stored logarithms of scales; a file with a negative scale, which the extension forbids, is taken as such.
"""

from __future__ import annotations

import json
import math
import os
import struct
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsplat.scene.files import replacing
from tsplat.scene.formats.checked import Json, Reader, malformed
from tsplat.scene.formats.fields import UP_AND_FRONT, Fields, Floats, log_scales_of, logits_of, opacities_of, rounded
from tsplat.scene.gaussians import SH_C0, Gaussians

EXTENSION = "KHR_gaussian_splatting"
HEADER, CHUNK_HEADER = struct.Struct("<4sII"), struct.Struct("<I4s")     # magic, version, size; size, kind
MAGIC, POINTS, FLOAT, BYTE = b"glTF", 0, 5126, 5121
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", FLOAT: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
MAX_DEGREE = 3
MAX_PARTS = 1000                            # primitives of splats: each takes about 1 ms, and a few bytes of JSON name it again
MIN_SPLAT = 3                               # bytes that a splat takes in a file at least, to bound what a small file can ask for
TOLERANCE = 1e-4                            # relative, of what a node's matrix may deviate from a rotation and a scale


def read_glb(path: str | os.PathLike[str]) -> Gaussians:
    """Read the splats of all nodes of a .glb file's scene, moved, turned and scaled as their nodes say.

    Returns:
        float32 Gaussians with the axes of a .ply, of the highest degree (0 to 3) that occurs. Opacities of 0 and 1 get the logits +-16.

    Raises:
        ValueError: naming the file, where in it, and what is wrong. Compressed buffers, sparse accessors, other files than the .glb
            itself and nodes that shear or mirror are not supported.
        OSError: the file cannot be read.
    """
    path = Path(path)
    reader = Reader(path, path.read_bytes())
    magic, version, size = HEADER.unpack(reader.take(HEADER.size, "the header"))
    if magic != MAGIC or version != 2:
        raise malformed(path, 0, f"expected a .glb file of version 2, which begins with {MAGIC!r}; got {magic!r} and version {version}")
    if size != len(reader.data):
        raise malformed(path, 8, f"expected {len(reader.data)} bytes, which the file has; its header says {size}")
    length, kind = CHUNK_HEADER.unpack(reader.take(CHUNK_HEADER.size, "the header of a chunk"))
    if kind != b"JSON":
        raise malformed(path, reader.offset - 4, f"expected a JSON chunk first; got {kind!r}")
    document = Json.parse(path, reader.take(length, "the JSON chunk"), reader.offset - length)
    binary = Reader(path, b"", reader.offset)
    while reader.position < size:
        length, kind = CHUNK_HEADER.unpack(reader.take(CHUNK_HEADER.size, "the header of a chunk"))
        start = reader.offset
        data = reader.take(length, "a chunk")
        if kind == b"BIN\0" and not binary.data:
            binary = Reader(path, data, start)

    parts: list[tuple[Json, Fields, NDArray[np.float64]]] = []
    budget = size // MIN_SPLAT
    for node, matrix in _nodes(document):
        for primitive in _primitives(document, node):
            fields = _read_primitive(document, binary, primitive, budget)
            budget -= len(fields)
            parts.append((node, fields, matrix))
            if len(parts) > MAX_PARTS:
                raise node.wrong(f"expected at most {MAX_PARTS} primitives of splats in the scene")
    if not parts:
        raise malformed(path, document.offset, f"expected a primitive with the extension {EXTENSION} in the scene; found none")
    logarithms = any(bool((fields.log_scales < 0).any()) for _, fields, _ in parts)
    placed = [_placed(node, fields, matrix, logarithms) for node, fields, matrix in parts]
    return Fields.joined(placed).turned(UP_AND_FRONT).gaussians()


def write_glb(path: str | os.PathLike[str], gaussians: Gaussians) -> None:
    """Write a .glb file of one node, in the order of `gaussians`. The new file takes the place of an old one only when it is whole.

    Everything is float32. What a file cannot hold is left out with a warning: degree 4, splats with NaN.

    Raises:
        ValueError: no splats, which glTF does not allow.
        OSError: the file cannot be written; an old one stays as it was.
    """
    fields = Fields.of(path, gaussians, MAX_DEGREE).turned(UP_AND_FRONT)
    if not len(fields):
        raise ValueError(f"{os.fspath(path)}: a .glb file holds at least 1 splat; got 0")
    opacities = opacities_of(fields.logits)[:, None]
    color = rounded(255 * np.concatenate([SH_C0 * fields.sh0 + 0.5, opacities], axis=1), 255).astype("u1")
    with np.errstate(over="ignore"):
        scales = np.exp(fields.log_scales).clip(0, np.finfo(np.float32).max)
    arrays = {"POSITION": fields.means, "COLOR_0": color, f"{EXTENSION}:ROTATION": np.roll(fields.quats, -1, axis=1),
              f"{EXTENSION}:SCALE": scales, f"{EXTENSION}:OPACITY": opacities, f"{EXTENSION}:{_harmonic(0)}": fields.sh0}
    arrays |= {f"{EXTENSION}:{_harmonic(k)}": fields.sh_rest[:, k - 1] for k in range(1, (fields.degree + 1) ** 2)}
    accessors: list[dict[str, Any]] = []
    views: list[dict[str, int]] = []
    blocks, offset = [], 0
    for values in arrays.values():
        component = BYTE if values.dtype == np.uint8 else FLOAT
        kind = next(name for name, width in WIDTHS.items() if width == values.shape[1])
        accessors.append({"bufferView": len(views), "componentType": component, "normalized": component == BYTE, "count": len(values), "type": kind})
        blocks.append(values.astype(COMPONENTS[component]).tobytes())
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(blocks[-1])})
        offset += len(blocks[-1])                                            # rows of 4, 12 or 16 bytes: all views begin at multiples of 4
    accessors[0] |= {end: [float(v) for v in bound] for end, bound in (("min", fields.means.min(0)), ("max", fields.means.max(0)))}
    primitive = {"attributes": {name: i for i, name in enumerate(arrays)}, "mode": POINTS, "extensions": {EXTENSION: {
        "kernel": "ellipse", "colorSpace": "srgb_rec709_display", "sortingMethod": "cameraDistance", "projection": "perspective"}}}
    document = {"asset": {"version": "2.0", "generator": "tsplat"}, "extensionsUsed": [EXTENSION], "scene": 0, "scenes": [{"nodes": [0]}],
                "nodes": [{"mesh": 0}], "meshes": [{"primitives": [primitive]}], "buffers": [{"byteLength": offset}], "bufferViews": views,
                "accessors": accessors}
    text = json.dumps(document, separators=(",", ":")).encode("ascii")
    text += b" " * (-len(text) % 4)
    total = HEADER.size + 2 * CHUNK_HEADER.size + len(text) + offset
    if total >= 1 << 32:
        raise ValueError(f"{os.fspath(path)}: a .glb file has less than 4 GiB; {len(fields)} splats of degree {fields.degree} take {total} bytes")
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(HEADER.pack(MAGIC, 2, total) + CHUNK_HEADER.pack(len(text), b"JSON") + text + CHUNK_HEADER.pack(offset, b"BIN\0"))
        file.writelines(blocks)


def _harmonic(k: int) -> str:
    degree = math.isqrt(k)
    return f"SH_DEGREE_{degree}_COEF_{k - degree ** 2}"


def _nodes(document: Json) -> list[tuple[Json, NDArray[np.float64]]]:
    """The nodes of the scene with their matrices `[4, 4]` to the world; all nodes that no other has as a child where there is no scene."""
    if "nodes" not in document.value:
        return []
    nodes = [document.at("nodes").at(i) for i in range(len(document.get("nodes", list)))]
    children = [[node.at("children").at(i) for i in range(len(node.get("children", list, [])))] for node in nodes]
    indices = [[_index(child, len(nodes)) for child in family] for family in children]
    if "scenes" in document.value:
        scene = document.at("scenes").at(document.get("scene", int, 0))
        start = [_index(scene.at("nodes").at(i), len(nodes)) for i in range(len(scene.get("nodes", list, [])))]
    else:
        start = sorted(set(range(len(nodes))) - {i for family in indices for i in family})
    waiting = [(i, np.eye(4)) for i in reversed(start)]
    found: dict[int, NDArray[np.float64]] = {}
    while waiting:
        i, parent = waiting.pop()
        if i in found:
            raise nodes[i].wrong("expected a tree of nodes; it occurs twice")
        with np.errstate(over="ignore", invalid="ignore"):
            found[i] = parent @ _matrix(nodes[i])
        waiting += [(child, found[i]) for child in reversed(indices[i])]
    return [(nodes[i], matrix) for i, matrix in found.items()]


def _index(member: Json, count: int) -> int:
    if not isinstance(member.value, int) or isinstance(member.value, bool) or not 0 <= member.value < count:
        raise member.wrong(f"expected an index below {count}")
    return member.value


def _matrix(node: Json) -> NDArray[np.float64]:
    if not isinstance(node.value, dict):
        raise node.wrong("expected an object")
    if "matrix" in node.value:
        return node.numbers("matrix", 16).reshape(4, 4).T                    # column by column in the file
    move, turn, size = (node.numbers(key, len(default)) if key in node.value else np.array(default)
                        for key, default in (("translation", [0.0] * 3), ("rotation", [0.0, 0.0, 0.0, 1.0]), ("scale", [1.0] * 3)))
    x, y, z, w = turn
    matrix = np.eye(4)
    with np.errstate(over="ignore", invalid="ignore"):
        matrix[:3, :3] = np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                                   [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                                   [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]) * size
    matrix[:3, 3] = move
    return matrix


def _primitives(document: Json, node: Json) -> list[Json]:
    """Those of the node's mesh that are splats."""
    if "mesh" not in node.value:
        return []
    mesh = document.at("meshes").at(node.get("mesh", int))
    primitives = [mesh.at("primitives").at(i) for i in range(len(mesh.get("primitives", list)))]
    return [primitive for primitive in primitives if EXTENSION in primitive.get("extensions", dict, {})]


def _read_primitive(document: Json, binary: Reader, primitive: Json, budget: int) -> Fields:
    """The splats of a primitive as they are, `log_scales` with the scales or their logarithms."""
    extension = primitive.at("extensions").at(EXTENSION)
    if extension.get("extensions", dict, {}):
        raise extension.wrong(f"compressed splats are not supported; found {', '.join(extension.value['extensions'])}")
    if primitive.get("mode", int, 4) != POINTS:
        raise primitive.wrong(f"expected mode {POINTS}, points; got {primitive.value.get('mode', 4)}")
    if extension.get("colorSpace", str, "").startswith("lin_"):
        warnings.warn(f"{binary.path}: colours in linear space are rendered as they are")
    attributes = primitive.at("attributes")
    names = attributes.value if isinstance(attributes.value, dict) else {}
    degree = next((degree for degree in range(MAX_DEGREE, 0, -1) if f"{EXTENSION}:{_harmonic(degree ** 2)}" in names), 0)

    def read(name: str, kind: str) -> Floats:
        index = attributes.at(name)
        accessor = document.at("accessors").at(_index(index, len(document.get("accessors", list))))
        if accessor.get("count", int) > budget:
            raise accessor.wrong(f"more splats than the file has room for: {accessor.value['count']}")
        return _read_accessor(document, binary, accessor, kind)

    arrays = [read("POSITION", "VEC3"), *(read(f"{EXTENSION}:{name}", kind) for name, kind in (
        ("ROTATION", "VEC4"), ("SCALE", "VEC3"), ("OPACITY", "SCALAR"), *((_harmonic(k), "VEC3") for k in range((degree + 1) ** 2))))]
    means, quats, scales, opacities, sh0, *rest = arrays
    if any(len(values) != len(means) for values in arrays):
        raise attributes.wrong(f"expected as many rows in all attributes; got {', '.join(str(len(values)) for values in arrays)}")
    sh_rest = np.stack(rest, axis=1) if rest else np.empty((len(means), 0, 3), np.float32)
    return Fields(means, np.roll(quats, 1, axis=1), scales, logits_of(opacities[:, 0]), sh0, sh_rest)


def _read_accessor(document: Json, binary: Reader, accessor: Json, kind: str) -> Floats:
    """The rows `[count, width]` of an accessor."""
    if accessor.get("type", str) != kind:
        raise accessor.wrong(f"expected type {kind}; got {accessor.value['type']}")
    component, count, first = accessor.get("componentType", int), accessor.get("count", int), accessor.get("byteOffset", int, 0)
    if component not in COMPONENTS:
        raise accessor.wrong(f"expected a componentType of {', '.join(map(str, COMPONENTS))}; got {component}")
    if "sparse" in accessor.value or "bufferView" not in accessor.value:
        raise accessor.wrong("sparse accessors are not supported")
    dtype, width = np.dtype(COMPONENTS[component]), WIDTHS[kind]
    view = document.at("bufferViews").at(accessor.get("bufferView", int))
    if view.get("extensions", dict, {}):
        raise view.wrong(f"compressed buffers are not supported; found {', '.join(view.value['extensions'])}")
    buffer = document.at("buffers").at(view.get("buffer", int))
    if view.value["buffer"] != 0 or buffer.get("uri", object, None) is not None:
        raise view.wrong("expected a view of buffer 0, which is in the .glb file")
    start, size = view.get("byteOffset", int, 0), view.get("byteLength", int)
    row = dtype.itemsize * width
    stride = view.get("byteStride", int, row)
    if not (0 <= start and 0 <= size and start + size <= len(binary.data)):
        raise view.wrong(f"expected a view within {len(binary.data)} bytes; got {size} at {start}")
    if not (0 <= count and 0 <= first and row <= stride and (count == 0 or first + (count - 1) * stride + row <= size)):
        raise accessor.wrong(f"expected {count} rows of {row} bytes, {stride} apart, from byte {first} of a view of {size} bytes")
    if not count:
        return np.empty((0, width), np.float32)
    values: Floats = np.ndarray((count, width), dtype, binary.data, start + first, (stride, dtype.itemsize)).astype(np.float32)
    if accessor.get("normalized", bool, False) and component != FLOAT:
        values = np.maximum(values / np.iinfo(dtype).max, -1)
    return values


def _placed(node: Json, fields: Fields, matrix: NDArray[np.float64], logarithms: bool) -> Fields:
    """The splats in the world."""
    linear = matrix[:3, :3]
    with np.errstate(over="ignore"):
        scale = float(np.cbrt(np.linalg.det(linear))) if np.isfinite(matrix).all() else 0.0
    if not 0 < scale < math.inf or not np.allclose(linear @ linear.T, scale ** 2 * np.eye(3), rtol=0, atol=TOLERANCE * scale ** 2):
        raise node.wrong("expected a matrix that moves, turns and scales all axes alike, as splats cannot be sheared or mirrored")
    log_scales = (fields.log_scales if logarithms else log_scales_of(fields.log_scales)) + np.float32(math.log(scale))
    if not np.array_equal(linear, scale * np.eye(3)):
        fields = fields.turned(linear / scale)
    with np.errstate(over="ignore", invalid="ignore"):
        means = fields.means * np.float32(scale) + matrix[:3, 3].astype(np.float32)
    return replace(fields, means=means, log_scales=log_scales)
