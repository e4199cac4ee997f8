"""Meshes as PLY and as GLB, the binary form of glTF 2.0: whole or not at all."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Bytes, Ints
from bmask_slam.graph.files.whole_file import whole_file
from bmask_slam.mapping.products.cloud import Cloud
from bmask_slam.mapping.products.cloud_files import ply_properties, ply_rows

_FACE = np.dtype([("count", "u1"), ("vertices", "<i4", 3)])


def write_mesh(path: Path, vertices: Cloud, triangles: Ints) -> Path:
    """Write a mesh of N vertices, with the columns of a cloud, and triangles (M, 3) of them."""
    faces = np.empty(len(triangles), _FACE)
    faces["count"], faces["vertices"] = 3, triangles
    lines = ["ply", "format binary_little_endian 1.0", "comment bmask-slam, world frame, metres"]
    lines += [f"element vertex {len(vertices)}", *ply_properties()]
    lines += [
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    with whole_file(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join(lines).encode("ascii"))
        file.write(ply_rows(vertices).tobytes())
        file.write(faces.tobytes())
    return path


_GLTF_KINDS = {"<f4": 5126, "<u2": 5123, "<u4": 5125}
_GLTF_SHAPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_VERTICES, _INDICES = 34962, 34963


def write_glb(path: Path, vertices: Cloud, triangles: Ints, up_world: Array) -> Path:
    """Write a mesh as GLB, for viewers: colours without lighting, as they were seen.

    glTF's y axis is up: a matrix turns the mesh, whose coordinates are the world's, in metres.
    ``_LABEL`` and ``_SIGMA`` of each vertex are its label and standard deviation in metres.
    """
    attributes: dict[str, NDArray] = {
        "POSITION": vertices.points.astype("<f4"),
        "NORMAL": vertices.normals.astype("<f4"),
        "COLOR_0": _linear(vertices.colours),
        "_LABEL": vertices.labels.astype("<f4"),
        "_SIGMA": vertices.sigmas_m.astype("<f4"),
    }
    parts = [*attributes.values(), triangles.astype("<u4").reshape(-1)]
    document = _document(list(attributes), parts, _upright(up_world))
    text = json.dumps(document, separators=(",", ":")).encode("ascii")
    text += b" " * (-len(text) % 4)
    size = sum(part.nbytes for part in parts)
    with whole_file(path) as temporary, temporary.open("wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + size))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", size, b"BIN\0"))
        for part in parts:
            file.write(part.tobytes())
    return path


def _document(names: list[str], parts: list[NDArray], T_gltf_world: Array) -> dict[str, Any]:
    """The description of a mesh: vertices' attributes by name, then the triangles' vertices."""
    first = np.cumsum([0, *(part.nbytes for part in parts)]).tolist()
    accessors = [_accessor(k, part) for k, part in enumerate(parts)]
    accessors[0] |= {n: getattr(parts[0], n)(axis=0).tolist() for n in ("min", "max")}
    views = [
        {"buffer": 0, "byteOffset": at, "byteLength": part.nbytes, "target": _VERTICES}
        for at, part in zip(first, parts, strict=False)
    ]
    views[-1]["target"] = _INDICES
    attributes = {name: k for k, name in enumerate(names)}
    primitive = {"attributes": attributes, "indices": len(names), "material": 0}
    return {
        "asset": {"version": "2.0", "generator": "bmask-slam"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "matrix": T_gltf_world.T.reshape(-1).tolist()}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [{"extensions": {"KHR_materials_unlit": {}}}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": first[-1]}],
    }


def _accessor(number: int, values: NDArray) -> dict[str, Any]:
    """How a part (N,) or (N, C) of the buffer is to be read."""
    columns = 1 if values.ndim == 1 else values.shape[1]
    found = {
        "bufferView": number,
        "componentType": _GLTF_KINDS[values.dtype.str],
        "count": len(values),
        "type": _GLTF_SHAPES[columns],
    }
    return found | {"normalized": True} if values.dtype.str == "<u2" else found


def _linear(colours: Bytes) -> NDArray[np.uint16]:
    """sRGB colours (N, 3) as linear light (N, 4) with alpha, 65535 for 1 (IEC 61966-2-1)."""
    value = np.arange(256) / 255
    curve = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    found = np.full((len(colours), 4), 65535, "<u2")
    found[:, :3] = np.rint(65535 * curve).astype("<u2")[colours]
    return found


def _upright(up_world: Array) -> Array:
    """T_gltf_world (4, 4): y is up, and the world's first camera looks along -z."""
    up = up_world / np.linalg.norm(up_world)
    ahead = np.eye(3)[2] if abs(up[2]) < 0.9 else np.eye(3)[1]
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    T_gltf_world = np.eye(4)
    T_gltf_world[:3, :3] = right, up, np.cross(right, up)
    return T_gltf_world
