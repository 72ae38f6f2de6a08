"""Is this a sound GLB, and how many triangles has it? After the glTF 2.0 specification, section 4.

Independent of the server's writer and of trimesh's reader, which forgives much. Knows only what a
level of detail may contain: one embedded buffer, no sparse accessors, plain triangles.
"""

import json
import struct
from typing import Any

import numpy as np

_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


class Unsound(ValueError):
    """The bytes are no sound GLB; the text says where."""


def n_triangles(content: bytes) -> int:
    """Triangles of all primitives, after every check."""
    gltf, binary = chunks(content)
    arrays = [accessor(gltf, binary, i) for i in range(len(gltf.get("accessors", [])))]
    primitives = [p for mesh in gltf.get("meshes", []) for p in mesh["primitives"]]
    check(primitives, "no primitive")
    return sum(primitive_triangles(gltf, arrays, primitive) for primitive in primitives)


def chunks(content: bytes) -> tuple[dict[str, Any], bytes]:
    """The JSON and the binary chunk."""
    check(len(content) >= 20 and len(content) % 4 == 0, f"{len(content)} bytes")
    magic, version, size = struct.unpack_from("<4sII", content)
    check((magic, version) == (b"glTF", 2), f"header {magic!r}, version {version}")
    check(size == len(content), f"the header says {size} bytes, there are {len(content)}")
    found, at = [], 12
    while at < size:
        check(at + 8 <= size, f"a chunk header at {at} is cut off")
        n_bytes, kind = struct.unpack_from("<I4s", content, at)
        check(n_bytes % 4 == 0 and at + 8 + n_bytes <= size, f"chunk {kind!r} at {at} is cut off")
        found.append((kind, content[at + 8 : at + 8 + n_bytes]))
        at += 8 + n_bytes
    kinds = [kind for kind, _ in found]
    check(kinds == [b"JSON", b"BIN\0"], f"chunks {kinds}")
    gltf = json.loads(found[0][1])
    check(gltf["asset"]["version"] == "2.0", f"asset {gltf['asset']}")
    check(not gltf.get("extensionsRequired"), f"needs {gltf.get('extensionsRequired')}")
    (buffer,) = gltf["buffers"]
    check("uri" not in buffer, "a buffer outside the file")
    unused = len(found[1][1]) - buffer["byteLength"]
    check(0 <= unused < 4, f"{unused} bytes of the binary chunk are unused")
    return gltf, found[1][1][: buffer["byteLength"]]


def accessor(gltf: dict[str, Any], binary: bytes, index: int) -> np.ndarray:
    """The values of an accessor, one row an element; its declared bounds hold."""
    it, where = gltf["accessors"][index], f"accessor {index}"
    check("sparse" not in it and it["count"] >= 1, f"{where}: sparse or empty")
    view = gltf["bufferViews"][it["bufferView"]]
    start, length = view.get("byteOffset", 0), view["byteLength"]
    check(0 <= start and start + length <= len(binary), f"{where}: its view is past the end")
    kind = np.dtype(_COMPONENTS[it["componentType"]])
    width, offset = _WIDTHS[it["type"]], it.get("byteOffset", 0)
    row = width * kind.itemsize
    stride = view.get("byteStride", row)
    check(
        (start + offset) % kind.itemsize == 0 and stride % kind.itemsize == 0, f"{where}: unaligned"
    )
    check(offset + stride * (it["count"] - 1) + row <= length, f"{where}: past the end of its view")
    shape, strides = (it["count"], width), (stride, kind.itemsize)
    values = np.ndarray(shape, kind, binary, start + offset, strides)
    check(kind.kind != "f" or bool(np.isfinite(values).all()), f"{where}: not finite")
    for name, bound in (("min", values.min(axis=0)), ("max", values.max(axis=0))):
        if name in it:
            declared = np.array(it[name], dtype=kind)
            check(np.array_equal(declared, bound), f"{where}: {name} {declared}, found {bound}")
    return values


def primitive_triangles(gltf: dict[str, Any], arrays: list[np.ndarray], primitive: dict) -> int:
    """Triangles of a primitive whose attributes and indices agree."""
    check(primitive.get("mode", 4) == 4, f"mode {primitive.get('mode')}")
    position = primitive["attributes"]["POSITION"]
    check({"min", "max"} <= gltf["accessors"][position].keys(), "positions without min and max")
    n_vertices = len(arrays[position])
    for name, index in primitive["attributes"].items():
        check(len(arrays[index]) == n_vertices, f"{name}: {len(arrays[index])} for {n_vertices}")
    indices = arrays[primitive["indices"]][:, 0] if "indices" in primitive else range(n_vertices)
    check(len(indices) % 3 == 0, f"{len(indices)} corners")
    check(int(max(indices)) < n_vertices, f"index {max(indices)} of {n_vertices} vertices")
    return len(indices) // 3


def check(holds: object, text: str) -> None:
    """Raises Unsound with `text` unless `holds`."""
    if not holds:
        raise Unsound(text)
