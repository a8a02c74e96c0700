"""Meshes as files: what is written is read back, by our reader, by open3d's, and by hand from the specification."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfmapp.formats.glb import write_glb
from sfmapp.formats.mesh_ply import write_mesh_ply
from sfmapp.formats.ply_reader import read_ply_geometry
from sfmapp.scene.mesh import Mesh, face_vectors, vertex_normals
from sfmapp.surface.open3d_library import load_open3d


def tetrahedron(origin: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Mesh:
    xyz = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]]) + origin
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
    rgb = np.array([[0, 0, 0], [255, 255, 255], [188, 10, 128], [1, 2, 3]], np.uint8)
    return Mesh(xyz, faces, vertex_normals(xyz, faces), rgb)


def test_normals_are_outward_and_areas_exact() -> None:
    mesh = tetrahedron()
    vectors = face_vectors(mesh.xyz, mesh.faces)
    np.testing.assert_allclose(vectors[:3], [[0, 0, -1.0], [0, -1.5, 0], [-3.0, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(vectors.sum(axis=0), 0.0, atol=1e-12)  # as for every closed surface
    outward = np.einsum("nc,nc->n", mesh.normal, mesh.xyz - mesh.xyz.mean(axis=0))
    assert (outward > 0.0).all()


def test_normal_of_a_vertex_without_faces_is_finite() -> None:
    xyz = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]])
    normal = vertex_normals(xyz, np.array([[0, 1, 2]], np.int32))
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0)


@pytest.mark.parametrize(("origin", "kind"), [((0.0, 0.0, 0.0), "float"), ((4.5e5, 5.2e6, 300.1), "double")])
def test_ply_round_trip(tmp_path: Path, origin: tuple[float, float, float], kind: str) -> None:
    mesh = tetrahedron(origin)
    write_mesh_ply(tmp_path / "mesh.ply", mesh)
    assert f"property {kind} x".encode() in (tmp_path / "mesh.ply").read_bytes()
    read = read_ply_geometry(tmp_path / "mesh.ply")
    np.testing.assert_array_equal(read.triangles, mesh.faces)
    for name in ("xyz", "normal", "rgb"):
        np.testing.assert_array_equal(getattr(read, name), getattr(mesh, name))
        assert getattr(read, name).dtype == getattr(mesh, name).dtype


def test_open3d_reads_our_ply_and_we_read_its(tmp_path: Path) -> None:
    open3d = load_open3d()
    mesh = tetrahedron()
    write_mesh_ply(tmp_path / "ours.ply", mesh)
    theirs = open3d.io.read_triangle_mesh(str(tmp_path / "ours.ply"))
    np.testing.assert_array_equal(np.asarray(theirs.vertices), mesh.xyz)
    np.testing.assert_array_equal(np.asarray(theirs.triangles), mesh.faces)
    np.testing.assert_allclose(np.asarray(theirs.vertex_colors), mesh.rgb / 255.0)
    np.testing.assert_allclose(np.asarray(theirs.vertex_normals), mesh.normal)
    theirs.vertex_normals = open3d.utility.Vector3dVector()
    open3d.io.write_triangle_mesh(str(tmp_path / "theirs.ply"), theirs)
    read = read_ply_geometry(tmp_path / "theirs.ply")
    np.testing.assert_array_equal(read.xyz, mesh.xyz)
    np.testing.assert_array_equal(read.triangles, mesh.faces)
    np.testing.assert_array_equal(read.rgb, mesh.rgb)
    assert read.normal is None


COMPONENTS = {5126: "<f4", 5123: "<u2", 5125: "<u4"}
NUM_VALUES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def parse_glb(path: Path) -> tuple[dict[str, Any], bytes]:
    """The document and the binary part, as section 4.4 of the glTF 2.0 specification lays them out."""
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    assert size % 4 == 0
    document = json.loads(data[20 : 20 + size])
    num_bytes, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert kind == b"BIN\0"
    assert 28 + size + num_bytes == len(data)
    assert document["buffers"] == [{"byteLength": num_bytes}]
    return document, data[28 + size :]


def values(document: dict[str, Any], binary: bytes, accessor: int) -> np.ndarray:
    entry = document["accessors"][accessor]
    view = document["bufferViews"][entry["bufferView"]]
    assert view["byteOffset"] % 4 == 0
    dtype = np.dtype(COMPONENTS[entry["componentType"]])
    array = np.frombuffer(binary, dtype, entry["count"] * NUM_VALUES[entry["type"]], view["byteOffset"])
    assert array.nbytes == view["byteLength"]
    return array.reshape(entry["count"], -1)


def to_scene(document: dict[str, Any], positions: np.ndarray) -> np.ndarray:
    """Positions after the transforms of the nodes, from the mesh up to the scene."""
    world, surface = document["nodes"]
    assert document["scenes"][0]["nodes"] == [0]
    assert world["children"] == [1]
    return Rotation.from_quat(world["rotation"]).apply(positions.astype(np.float64) + surface["translation"])


@pytest.mark.parametrize("is_z_up", [False, True])
def test_glb_stands_upright_and_keeps_large_coordinates(tmp_path: Path, is_z_up: bool) -> None:
    mesh = tetrahedron((4.5e5, 5.2e6, 300.1))
    write_glb(tmp_path / "mesh.glb", mesh, is_z_up=is_z_up)
    document, binary = parse_glb(tmp_path / "mesh.glb")
    primitive = document["meshes"][0]["primitives"][0]
    positions = values(document, binary, primitive["attributes"]["POSITION"])
    x, y, z = mesh.xyz.T
    upright = np.stack([x, z, -y], axis=1) if is_z_up else np.stack([x, -y, -z], axis=1)
    np.testing.assert_allclose(to_scene(document, positions), upright, rtol=0.0, atol=1e-6)
    bounds = document["accessors"][primitive["attributes"]["POSITION"]]
    np.testing.assert_array_equal(bounds["min"], positions.min(axis=0))
    np.testing.assert_array_equal(bounds["max"], positions.max(axis=0))
    np.testing.assert_array_equal(values(document, binary, primitive["indices"]).reshape(-1, 3), mesh.faces)
    np.testing.assert_array_equal(values(document, binary, primitive["attributes"]["NORMAL"]), mesh.normal)


def test_glb_colours_are_linear_light(tmp_path: Path) -> None:
    write_glb(tmp_path / "mesh.glb", tetrahedron())
    document, binary = parse_glb(tmp_path / "mesh.glb")
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    assert document["accessors"][attributes["COLOR_0"]]["normalized"] is True
    color = values(document, binary, attributes["COLOR_0"]) / 65535.0
    # sRGB 188 is half of white's light, 128 a little over a fifth; black and white stay what they are
    np.testing.assert_allclose(color[2, [0, 2]], [0.5029, 0.2159], atol=1e-4)
    np.testing.assert_array_equal(color[:2, :3], [[0, 0, 0], [1, 1, 1]])
    np.testing.assert_array_equal(color[:, 3], 1.0)
    assert document["materials"][0]["extensions"] == {"KHR_materials_unlit": {}}


def test_glb_holds_the_texture(tmp_path: Path) -> None:
    plain = tetrahedron()
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]], np.float32)
    texture = np.zeros((64, 64, 3), np.uint8)
    texture[:32] = 200, 40, 90
    write_glb(tmp_path / "mesh.glb", Mesh(plain.xyz, plain.faces, plain.normal, plain.rgb, uv, texture))
    document, binary = parse_glb(tmp_path / "mesh.glb")
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    assert "COLOR_0" not in attributes  # it would be multiplied with the texture
    np.testing.assert_array_equal(values(document, binary, attributes["TEXCOORD_0"]), uv)
    view = document["bufferViews"][document["images"][0]["bufferView"]]
    image = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    decoded = cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]
    assert np.abs(decoded[:24].astype(int) - [200, 40, 90]).max() <= 4
    assert decoded[40:].max() <= 4


def test_open3d_reads_our_glb(tmp_path: Path) -> None:
    open3d = load_open3d()
    mesh = tetrahedron((10.0, 20.0, 30.0))
    write_glb(tmp_path / "mesh.glb", mesh)
    theirs = open3d.io.read_triangle_mesh(str(tmp_path / "mesh.glb"))
    assert len(theirs.triangles) == 4
    np.testing.assert_allclose(np.ptp(np.asarray(theirs.vertices), axis=0), [1.0, 2.0, 3.0], atol=1e-6)
