"""PLY files of other programs."""

from __future__ import annotations

import struct
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.formats.ply import write_ply
from sfmapp.formats.ply_reader import read_ply_geometry
from sfmapp.surface.open3d_library import load_open3d

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


# clouds as other programs write them ---------------------------------------------------------------------------------

NORMAL = np.array([[0, 0, 1], [0.5, -2, 0.25], [0, 0, 0], [-1, 0, 0], [0, 1, 0]], np.float32)
RGB = np.array([[0, 10, 255], [1, 2, 3], [255, 255, 255], [128, 64, 32], [7, 77, 177]], np.uint8)


def cloud(kind: str, columns: list[tuple[str, str, NDArray[Any]]], line_end: str = "\n", extra: str = "") -> bytes:
    """A PLY of (type, name, values (N,)), with the header's lines ended as given."""
    types = {"float": "f4", "double": "f8", "uchar": "u1", "ushort": "u2", "int": "i4", "uint8": "u1", "char": "i1"}
    body = extra + f"element vertex {len(columns[0][2])}\n" + "".join(f"property {t} {n}\n" for t, n, _ in columns)
    header = head(kind, body).replace(b"\n", line_end.encode())
    if kind == "ascii":
        rows = zip(*(values.tolist() for _, _, values in columns), strict=True)
        return header + "".join(" ".join(map(repr, row)) + line_end for row in rows).encode()
    order = "<" if "little" in kind else ">"
    table = np.empty(len(columns[0][2]), [(name, order + types[t]) for t, name, _ in columns])
    for _, name, values in columns:
        table[name] = values
    return header + table.tobytes()


def columns(kind: str, names: str, values: NDArray[Any]) -> list[tuple[str, str, NDArray[Any]]]:
    return [(kind, name, values[:, k]) for k, name in enumerate(names.split())]


@pytest.mark.parametrize(
    ("kind", "line_end"),
    [
        *(("ascii", line_end) for line_end in ("\n", "\r\n")),
        *((kind, end) for kind in ("binary_little_endian", "binary_big_endian") for end in ("\n", "\r\n", "\r")),
    ],
)
def test_one_cloud_in_every_encoding(tmp_path: Path, kind: str, line_end: str) -> None:
    data = cloud(
        kind,
        columns("double", "x y z", XYZ)
        + columns("float", "nx ny nz", NORMAL)
        + columns("uchar", "red green blue", RGB),
        line_end,
    )
    (tmp_path / "a.ply").write_bytes(data)
    found = read_ply_geometry(tmp_path / "a.ply")
    np.testing.assert_array_equal(found.xyz, XYZ)
    np.testing.assert_array_equal(found.normal, NORMAL)
    np.testing.assert_array_equal(found.rgb, RGB)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize(
    ("ply_type", "names", "values"),
    [
        ("uchar", "red green blue", RGB),
        ("uint8", "diffuse_red diffuse_green diffuse_blue", RGB),
        ("uchar", "r g b", RGB),
        ("uchar", "Red Green Blue", RGB),
        ("float", "red green blue", (RGB / 255).astype(np.float32)),
        ("double", "r g b", RGB / 255),
        ("float", "red green blue", RGB.astype(np.float32)),
        ("ushort", "red green blue", RGB.astype(np.uint16) * 257),
        ("ushort", "red green blue", RGB.astype(np.uint16)),
        ("int", "red green blue", RGB.astype(np.int32)),
    ],
)
def test_colours_by_any_name_and_type(
    tmp_path: Path, ply_type: str, names: str, values: NDArray[Any], kind: str
) -> None:
    data = cloud(kind, columns("float", "X Y Z", XYZ.astype(np.float32)) + columns(ply_type, names, values))
    (tmp_path / "a.ply").write_bytes(data)
    found = read_ply_geometry(tmp_path / "a.ply")
    np.testing.assert_array_equal(found.rgb, RGB)
    np.testing.assert_array_equal(found.xyz, XYZ)
    assert found.normal is None


def test_fractions_that_overshoot_white(tmp_path: Path) -> None:
    shares = np.where(RGB == 255, 1.02, RGB / 255)
    data = cloud("ascii", columns("double", "x y z", XYZ) + columns("float", "r g b", shares))
    (tmp_path / "a.ply").write_bytes(data)
    np.testing.assert_array_equal(read_ply_geometry(tmp_path / "a.ply").rgb, RGB)


def test_dark_whole_numbers_are_not_fractions(tmp_path: Path) -> None:
    dark = RGB // 255
    (tmp_path / "a.ply").write_bytes(cloud("ascii", columns("double", "x y z", XYZ) + columns("int", "r g b", dark)))
    np.testing.assert_array_equal(read_ply_geometry(tmp_path / "a.ply").rgb, dark)


@pytest.mark.parametrize("names", ["normal_x normal_y normal_z", "nX nY nZ", "normalx normaly normalz"])
def test_normals_by_any_name(tmp_path: Path, names: str) -> None:
    data = cloud("binary_little_endian", columns("double", "x y z", XYZ) + columns("double", names, NORMAL))
    (tmp_path / "a.ply").write_bytes(data)
    np.testing.assert_array_equal(read_ply_geometry(tmp_path / "a.ply").normal, NORMAL)


@pytest.mark.parametrize("alike", [True, False])
@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_lists_among_the_numbers_of_vertices(tmp_path: Path, kind: str, alike: bool) -> None:
    """As OpenMVS writes dense clouds: each point with the views that see it, and their weights."""
    body = "element vertex 5\nproperty float x\nproperty float y\nproperty list uchar uint view_indices\n"
    body += "property float z\nproperty list uchar float view_weights\nproperty uchar red\nproperty uchar green\n"
    body += "property uchar blue\n"
    rng, data = np.random.default_rng(0), head(kind, body)
    order = ">" if "big" in kind else "<"
    for (x, y, z), rgb in zip(XYZ, RGB, strict=True):
        views = list(range(3 if alike else int(rng.integers(0, 6))))
        if kind == "ascii":
            row = [x, y, len(views), *views, z, len(views), *(0.5 for _ in views), *rgb]
            data += (" ".join(map(str, row)) + "\n").encode()
        else:
            data += struct.pack(f"{order}2fB{len(views)}IfB{len(views)}f3B", x, y, len(views), *views, z, len(views),
                                *(0.5 for _ in views), *rgb)  # fmt: skip
    (tmp_path / "a.ply").write_bytes(data)
    found = read_ply_geometry(tmp_path / "a.ply")
    np.testing.assert_array_equal(found.xyz, XYZ)
    np.testing.assert_array_equal(found.rgb, RGB)
    (tmp_path / "a.ply").write_bytes(data[:-4])
    with pytest.raises(InputError, match=r"truncated|expected row 4"):
        read_ply_geometry(tmp_path / "a.ply")


def test_open3d_reads_the_same(tmp_path: Path) -> None:
    open3d = load_open3d()
    theirs = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(XYZ))
    theirs.normals = open3d.utility.Vector3dVector(NORMAL)
    theirs.colors = open3d.utility.Vector3dVector(RGB / 255)
    for is_text in (False, True):
        open3d.io.write_point_cloud(str(tmp_path / "a.ply"), theirs, write_ascii=is_text)
        found = read_ply_geometry(tmp_path / "a.ply")
        np.testing.assert_array_equal(found.xyz, XYZ)
        np.testing.assert_array_equal(found.normal, NORMAL)
        np.testing.assert_array_equal(found.rgb, RGB)


def test_a_binary_file_that_was_sent_as_text_is_refused(tmp_path: Path) -> None:
    data = cloud("binary_little_endian", columns("uchar", "x y z", np.full((5, 3), 10)))
    (tmp_path / "a.ply").write_bytes(data.replace(b"\n", b"\r\n"))
    with pytest.raises(InputError, match="found more"):
        read_ply_geometry(tmp_path / "a.ply")


def test_a_list_that_would_fill_the_memory_is_not_believed(tmp_path: Path) -> None:
    """If all rows were as long as the first one, they would take 40 MB: the file has half of one."""
    body = "element vertex 20000\nproperty char x\nproperty char y\nproperty char z\n"
    data = head("binary_little_endian", body + "property list uchar double a\n") + b"\x01\x02\x03\xff" + bytes(2040)
    (tmp_path / "a.ply").write_bytes(data + bytes(79_000))
    tracemalloc.start()
    with pytest.raises(InputError, match="truncated in row"):
        read_ply_geometry(tmp_path / "a.ply")
    assert tracemalloc.get_traced_memory()[1] < 5e6
    tracemalloc.stop()


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_files_are_refused_or_read(tmp_path: Path, data: st.DataObject) -> None:
    kind = data.draw(st.sampled_from(["ascii", "binary_little_endian", "binary_big_endian"]))
    order = ">" if "big" in kind else "<"
    body = VERTEX + "element face 2\nproperty list uchar int vertex_indices\nproperty list uchar float texcoord\n"
    if kind == "ascii":
        rows = "".join(f"7 {z} {x} -3 {y}\n" for x, y, z in XYZ) + "3 0 1 2 0\n4 0 1 2 3 1 0.5\n"
        good = head(kind, body) + rows.encode()
    else:
        faces = struct.pack(order + "B3iB", 3, 0, 1, 2, 0) + struct.pack(order + "B4iBf", 4, 0, 1, 2, 3, 1, 0.5)
        good = head(kind, body) + vertex_bytes(order) + faces
    bad = bytearray(good)
    for at in data.draw(st.lists(st.integers(0, len(bad) - 1), min_size=1, max_size=4)):
        bad[at] ^= 1 << data.draw(st.integers(0, 7))
    bad = bad[: data.draw(st.sampled_from([len(bad), data.draw(st.integers(0, len(bad)))]))]
    (tmp_path / "a.ply").write_bytes(bytes(bad))
    try:
        found = read_ply_geometry(tmp_path / "a.ply")
    except InputError:
        return
    assert found.xyz.shape == (len(found.xyz), 3)
    if found.triangles is not None and len(found.triangles):
        assert 0 <= found.triangles.min() <= found.triangles.max() < len(found.xyz)
