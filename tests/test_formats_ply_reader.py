"""PLY files of other programs."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from sfmapp.errors import InputError
from sfmapp.formats.ply import write_ply
from sfmapp.formats.ply_reader import read_ply_geometry

XYZ = np.array([[0.5, -1.25, 3], [2, 0, 1], [4, 4, -8], [1, 1, 1], [0, 2, 0.125]])
VERTEX = """element vertex 5
property uchar quality
property float z
property double x
property short y4
property float32 y
"""


def head(kind: str, body: str) -> bytes:
    return f"ply\nformat {kind} 1.0\ncomment made by hand\n{body}end_header\n".encode()


def vertex_bytes(order: str) -> bytes:
    return b"".join(struct.pack(order + "Bfdhf", 7, z, x, -3, y) for x, y, z in XYZ)


@pytest.mark.parametrize(("kind", "order"), [("binary_little_endian", "<"), ("binary_big_endian", ">")])
def test_binary_of_both_orders_with_other_properties(tmp_path: Path, kind: str, order: str) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(head(kind, VERTEX) + vertex_bytes(order) + b"trailing bytes")
    found = read_ply_geometry(path)
    np.testing.assert_array_equal(found.xyz, XYZ)
    assert found.triangles is None


@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
def test_text(tmp_path: Path, line_end: str) -> None:
    rows = "".join(f"7 {z} {x} -3 {y}\n" for x, y, z in XYZ)
    faces = "element face 2\nproperty list uchar int vertex_indices\nproperty uchar red\n"
    text = head("ascii", VERTEX + faces).decode() + rows + "3 0 1 2 9\n\n4 0 2 3 4 9\n"
    path = tmp_path / "a.ply"
    path.write_bytes(text.replace("\n", line_end).encode())
    found = read_ply_geometry(path)
    np.testing.assert_array_equal(found.xyz, XYZ)
    assert found.triangles is not None
    assert found.triangles.tolist() == [[0, 1, 2], [0, 2, 3], [0, 3, 4]]


@pytest.mark.parametrize("sizes", [(3, 3), (4, 3)])
@pytest.mark.parametrize(("kind", "order"), [("binary_little_endian", "<"), ("binary_big_endian", ">")])
def test_faces_before_vertices_and_elements_in_between(
    tmp_path: Path, kind: str, order: str, sizes: tuple[int, int]
) -> None:
    """Lists all alike are read at once, others one by one; elements that nobody needs are passed over."""
    body = "element face 2\nproperty uchar flags\nproperty list uchar uint vertex_index\n"
    body += "property list uchar float texcoord\nelement edge 1\nproperty list ushort double weird\n"
    body += "element camera 1\nproperty double f\n" + VERTEX
    data = b""
    for size in sizes:
        data += struct.pack(f"{order}BB{size}IB2f", 1, size, *range(size), 2, 0.5, 0.5)
    data += struct.pack(order + "H3d", 3, 1, 2, 3) + struct.pack(order + "d", 700.0)
    path = tmp_path / "a.ply"
    path.write_bytes(head(kind, body) + data + vertex_bytes(order))
    found = read_ply_geometry(path)
    np.testing.assert_array_equal(found.xyz, XYZ)
    assert found.triangles is not None
    assert found.triangles.tolist() == [[0, 1, 2], *([[0, 2, 3]] if sizes[0] == 4 else []), [0, 1, 2]]


def test_our_own_clouds_and_an_empty_one(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", XYZ, np.zeros((5, 3), np.uint8))
    np.testing.assert_array_equal(read_ply_geometry(tmp_path / "a.ply").xyz, XYZ)
    for kind in ("ascii", "binary_big_endian"):
        (tmp_path / "b.ply").write_bytes(head(kind, VERTEX.replace("vertex 5", "vertex 0")))
        assert read_ply_geometry(tmp_path / "b.ply").xyz.shape == (0, 3)


def test_nan_is_left_to_the_reader(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(head("ascii", "element vertex 1\n" + "".join(
        f"property float {axis}\n" for axis in "xyz")) + b"nan 1 2\n")  # fmt: skip
    assert np.isnan(read_ply_geometry(tmp_path / "a.ply").xyz[0, 0])


PLAIN = "".join(f"property float {axis}\n" for axis in "xyz")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"solid cube", "expected a PLY header, found b'solid cube'"),
        (b"", "expected a PLY header"),
        (head("binary_middle_endian", VERTEX), "expected a format among"),
        (head("ascii", "element vertex many\n"), "found 'element vertex many'"),
        (head("ascii", "property float x\n"), "found 'property float x'"),
        (head("ascii", "element vertex 1\nproperty quaternion x\n"), "found 'property quaternion x'"),
        (head("ascii", "element vertex 1\nproperty list float int x\n"), "found 'property list float int x'"),
        (head("ascii", "element vertex 1\nproperty float x\nproperty float x\n"), "names of their own"),
        (head("ascii", "element points 1\n" + PLAIN), "expected one element 'vertex', found points"),
        (head("ascii", "element vertex 1\nproperty float x\n") + b"1\n", "x, y and z, found x"),
        (head("ascii", "element vertex 2\n" + PLAIN) + b"1 2 3\n", "truncated: expected 2 rows of 'vertex'"),
        (head("ascii", "element vertex 2\n" + PLAIN) + b"1 2 3\n1 two 3\n", "expected 3 numbers per vertex"),
        (head("ascii", "element vertex 2\n" + PLAIN) + b"1 2 3 4\n1 2 3 4\n", "rows of 'vertex' of 3 numbers"),
        (head("ascii", f"element vertex {10**17}\n" + PLAIN) + b"1 2 3\n", f"truncated: expected {10**17} rows"),
        (head("binary_little_endian", f"element vertex {10**17}\n" + PLAIN), f"truncated: expected {10**17} rows"),
        (head("binary_little_endian", VERTEX) + vertex_bytes("<")[:-1], "truncated: expected 5 rows of 'vertex'"),
    ],
)  # fmt: skip
def test_files_that_are_not_what_they_claim(tmp_path: Path, data: bytes, message: str) -> None:
    path = tmp_path / "bad.ply"
    path.write_bytes(data)
    with pytest.raises(InputError, match=message) as caught:
        read_ply_geometry(path)
    assert "bad.ply" in str(caught.value)


@pytest.mark.parametrize(
    ("faces", "message"),
    [
        (b"\x03" + struct.pack("<3i", 0, 1, 9), "faces of vertices 0 to 4, found 9"),
        (b"\x03" + struct.pack("<3i", 0, -1, 2), "faces of vertices 0 to 4, found -1"),
        (b"\x02" + struct.pack("<2i", 0, 1), "three corners and more, found 2"),
        (b"\xff" + struct.pack("<3i", 0, 1, 2), "truncated in row 0 of 'face', a list of 255"),
    ],
)
def test_bad_faces(tmp_path: Path, faces: bytes, message: str) -> None:
    body = VERTEX + "element face 1\nproperty list uchar int vertex_indices\n"
    (tmp_path / "a.ply").write_bytes(head("binary_little_endian", body) + vertex_bytes("<") + faces)
    with pytest.raises(InputError, match=message):
        read_ply_geometry(tmp_path / "a.ply")


def test_a_corner_beyond_64_bits(tmp_path: Path) -> None:
    body = "element vertex 1\n" + PLAIN + "element face 1\nproperty list uchar int vertex_indices\n"
    (tmp_path / "a.ply").write_bytes(head("ascii", body) + f"1 2 3\n3 0 0 {2**64}\n".encode())
    with pytest.raises(InputError, match="beyond 64 bits"):
        read_ply_geometry(tmp_path / "a.ply")


def test_names_of_properties_are_free(tmp_path: Path) -> None:
    """Counts of lists have names of their own in memory; none that a file gives collides with them."""
    body = VERTEX + "element face 1\nproperty uchar #vertex_indices\nproperty list uchar int vertex_indices\n"
    data = vertex_bytes("<") + b"\x07\x03" + struct.pack("<3i", 2, 1, 4)
    (tmp_path / "a.ply").write_bytes(head("binary_little_endian", body) + data)
    triangles = read_ply_geometry(tmp_path / "a.ply").triangles
    assert triangles is not None
    assert triangles.tolist() == [[2, 1, 4]]


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_ply_geometry(tmp_path / "none.ply")
