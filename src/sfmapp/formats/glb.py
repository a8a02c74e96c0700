"""Triangle meshes as GLB: binary glTF 2.0 (Khronos Group, "glTF 2.0 Specification", 2021)."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import SfmError
from sfmapp.formats.atomic import replaced_file
from sfmapp.scene.mesh import Mesh

# codes of the specification, sections 3.6 and 5
FLOAT, UNSIGNED_SHORT, UNSIGNED_INT = 5126, 5123, 5125
VERTICES, INDICES = 34962, 34963
LARGEST_BYTES = 2**32 - 1
JPEG_QUALITY = 92


def write_glb(path: str | Path, mesh: Mesh, *, is_z_up: bool = False) -> None:
    """Write a mesh with its texture, or with the colours of its vertices where it has none.

    glTF is y up, right-handed. The coordinates stay those of the world, less the centre of the mesh so that single
    precision holds large ones; the node above takes them to glTF's axes: by its translation back to the world, by its
    parent's rotation upright. The colours are those of photographs, with their light in them: the material is unlit
    (``KHR_materials_unlit``), so that no viewer lights them again.

    Args:
        mesh: what to write.
        is_z_up: the world has been aligned and z is up; otherwise it is that of a first camera, y down and z forward.

    Raises:
        InputError: the file cannot be written.
        SfmError: the mesh is larger than GLB can hold, 4 GiB.
    """
    buffer = _Buffer()
    center = (mesh.xyz.min(axis=0) + mesh.xyz.max(axis=0)) / 2.0 if len(mesh.xyz) else np.zeros(3)
    attributes = {
        "POSITION": buffer.accessor((mesh.xyz - center).astype("<f4"), FLOAT, "VEC3", VERTICES, bounds=True),
        "NORMAL": buffer.accessor(mesh.normal.astype("<f4"), FLOAT, "VEC3", VERTICES),
    }
    pbr: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    document: dict[str, Any] = {}
    if mesh.uv is not None and mesh.texture is not None:
        attributes["TEXCOORD_0"] = buffer.accessor(mesh.uv.astype("<f4"), FLOAT, "VEC2", VERTICES)
        document["images"] = [{"bufferView": buffer.view(_jpeg(mesh.texture)), "mimeType": "image/jpeg"}]
        document["samplers"] = [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}]
        document["textures"] = [{"source": 0, "sampler": 0}]
        pbr["baseColorTexture"] = {"index": 0}
    else:
        attributes["COLOR_0"] = buffer.accessor(_linear(mesh.rgb), UNSIGNED_SHORT, "VEC4", VERTICES, normalized=True)
    corners = buffer.accessor(mesh.faces.ravel().astype("<u4"), UNSIGNED_INT, "SCALAR", INDICES)
    # 90 degrees about x for z up, 180 for y down
    rotation = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5] if is_z_up else [1.0, 0.0, 0.0, 0.0]
    document |= {
        "asset": {"version": "2.0", "generator": "sfmapp"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"name": "world", "rotation": rotation, "children": [1]},
            {"name": "surface", "translation": center.tolist(), "mesh": 0},
        ],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": corners, "material": 0}]}],
        "materials": [
            {"pbrMetallicRoughness": pbr, "doubleSided": True, "extensions": {"KHR_materials_unlit": {}}},
        ],
    }
    _write(Path(path), document | buffer.parts(), buffer.chunks)


@dataclass
class _Buffer:
    """The binary part as it grows."""

    chunks: list[bytes] = field(default_factory=list)
    views: list[dict[str, int]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)
    num_bytes: int = 0

    def view(self, data: bytes, target: int | None = None) -> int:
        """Append bytes, aligned to four; the number of their view."""
        of_target = {} if target is None else {"target": target}
        self.views.append({"buffer": 0, "byteOffset": self.num_bytes, "byteLength": len(data)} | of_target)
        padded = data + b"\0" * (-len(data) % 4)
        self.chunks.append(padded)
        self.num_bytes += len(padded)
        return len(self.views) - 1

    def accessor(
        self,
        array: NDArray[Any],
        component: int,
        kind: str,
        target: int,
        *,
        bounds: bool = False,
        normalized: bool = False,
    ) -> int:
        """Append rows; the number of their accessor."""
        entry: dict[str, Any] = {
            "bufferView": self.view(array.tobytes(), target),
            "componentType": component,
            "count": len(array),
            "type": kind,
        }
        if bounds and len(array):
            entry |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
        if normalized:
            entry["normalized"] = True
        self.accessors.append(entry)
        return len(self.accessors) - 1

    def parts(self) -> dict[str, Any]:
        """What the document says of it."""
        buffers = [{"byteLength": self.num_bytes}]
        return {"buffers": buffers, "bufferViews": self.views, "accessors": self.accessors}


def _linear(rgb: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Opaque linear colours (N, 4) of sRGB ones (N, 3): glTF's vertex colours are linear, 65535 for white."""
    s = np.arange(256) / 255.0
    table = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    out = np.full((len(rgb), 4), 65535, "<u2")
    out[:, :3] = np.rint(65535.0 * table).astype("<u2")[rgb]
    return out


def _jpeg(texture: NDArray[np.uint8]) -> bytes:
    import cv2

    _, data = cv2.imencode(".jpg", texture[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return bytes(data)


def _write(path: Path, document: dict[str, Any], chunks: list[bytes]) -> None:
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    num_bytes = sum(map(len, chunks))
    total = 12 + 8 + len(text) + 8 + num_bytes
    if total > LARGEST_BYTES:
        raise SfmError(f"{path}: expected at most 4 GiB in a GLB file, found {total} bytes", "write PLY instead")
    with replaced_file(path) as beside, beside.open("wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, total))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", num_bytes, b"BIN\0"))
        for chunk in chunks:
            file.write(chunk)
