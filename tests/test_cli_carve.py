"""``sfmapp carve`` from the command line, on photographs of a solid whose shape is known."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

import sfmapp
from carving_scenes import around, box, mask_of, write_cameras
from schemas import check_schema
from sfmapp.carve.files import read_octree
from sfmapp.carve.octree import Octree
from sfmapp.cli.main import main
from sfmapp.errors import InputError
from sfmapp.formats.ply_reader import read_ply_geometry
from sfmapp.geometry import rigid3
from sfmapp.report.carve_pictures import slice_picture
from sfmapp.scene.mesh import Mesh, face_areas
from sfmapp.viewer.carve_recording import faces_of_level

VIEWS = around(10, width=120, height=90)
VOLUME = 1.6 * 1.2 * 1.0


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A box, red where x is positive and blue elsewhere, with an alpha channel."""
    folder = tmp_path_factory.mktemp("box")
    (folder / "images").mkdir()
    for view in VIEWS:
        assert view.camera is not None
        shown = mask_of(view, box())
        rgba = np.zeros((*shown.shape, 4), np.uint8)
        rgba[shown, 2] = 200 if view.center[0] > 0.0 else 30
        rgba[shown, 3] = 255
        cv2.imwrite(str(folder / "images" / view.name), rgba)
    write_cameras(folder, VIEWS)
    return folder


def carve(*args: object) -> int:
    return main(["carve", *map(str, args), "--cells", "32", "--no-recording", "-q"])


@pytest.fixture(scope="module")
def carved(photographs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("out") / "volume"
    assert carve(photographs, "-o", folder) == 0
    return folder


def test_the_volume_is_the_solids_and_a_little_more(carved: Path) -> None:
    report = json.loads((carved / "report.json").read_text())
    check_schema("carve", report)
    low, high = report["carving"]["volume_low"], report["carving"]["volume_high"]
    # the hull of ten outlines is a few per cent more than the solid, and cells are a twelfth of its height
    assert high > VOLUME
    assert low < report["surface"]["volume"] < high
    assert VOLUME < report["surface"]["volume"] < 1.2 * VOLUME
    assert min(view["iou"] for view in report["colors"]["views"]) > 0.94
    assert report["box"]["told_by"] == "silhouettes"
    # the box is a solid of 1.92 with an area of 7.52, seen from 20 degrees above and 10 below
    assert report["limits"]["volume_high"] > VOLUME
    assert report["limits"]["area_low"] < 7.52
    assert 0.0 < report["limits"]["unseen_share"] < 0.35
    octree = read_octree(carved / "octree.npz")
    assert octree.volume_bounds() == pytest.approx((low, high))


def test_the_mesh_has_the_colours_of_what_looks_at_it(carved: Path) -> None:
    mesh = read_ply_geometry(carved / "mesh.ply")
    assert mesh.rgb is not None
    assert mesh.normal is not None
    red, x = mesh.rgb[:, 0].astype(float), mesh.normal[:, 0]
    assert red[x > 0.9].mean() > 150.0
    assert red[x < -0.9].mean() < 80.0
    assert (carved / "mesh.glb").stat().st_size > 10_000


def test_photographs_are_its_texture(photographs: Path, tmp_path: Path) -> None:
    assert carve(photographs, "-o", tmp_path, "--texture") == 0
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["texture"]["seen"] > 0.8
    assert b"\xff\xd8\xff" in (tmp_path / "mesh.glb").read_bytes()


def test_the_same_call_goes_on_with_the_octree(photographs: Path, carved: Path, tmp_path: Path) -> None:
    shutil.copytree(carved, tmp_path / "again")
    before = (tmp_path / "again" / "mesh.ply").read_bytes()
    found = sfmapp.carve_volume(
        photographs, tmp_path / "again", sfmapp.load_options(settings=["carve.cells=32"]), threads=1
    )
    assert "carve" not in found.report.usage
    assert found.report.texture is None
    assert (tmp_path / "again" / "recording.rrd").read_bytes()[:4] == b"RRF2"
    assert (tmp_path / "again" / "mesh.ply").read_bytes() == before
    (tmp_path / "again" / "octree.npz").write_bytes(b"damaged")
    assert carve(photographs, "-o", tmp_path / "again", "--threads", 3) == 0
    assert (tmp_path / "again" / "mesh.ply").read_bytes() == before


def test_a_call_that_was_stopped_goes_on(photographs: Path, tmp_path: Path) -> None:
    events = sfmapp.Events()

    def stop(event: sfmapp.Event) -> None:
        if event.kind == "started" and event.stage == "surface":
            events.cancel()

    events.subscribe(stop)
    options = sfmapp.load_options(settings=["carve.cells=32"])
    with pytest.raises(sfmapp.InterruptedRunError):
        sfmapp.carve_volume(photographs, tmp_path / "out", options, events=events)
    assert not (tmp_path / "out" / "mesh.ply").exists()
    found = sfmapp.carve_volume(photographs, tmp_path / "out", options)
    assert "carve" not in found.report.usage
    assert VOLUME < found.report.surface.volume < 1.2 * VOLUME


def test_a_box_cuts_the_volume(photographs: Path, tmp_path: Path) -> None:
    options = sfmapp.load_options(settings=["carve.cells=32"])
    found = sfmapp.carve_volume(photographs, tmp_path / "cut", options, box=[-0.9, -0.8, -0.7, 0, 1, 1])
    assert found.mesh.xyz[:, 0].max() == pytest.approx(0.0, abs=0.05 * found.octree.cell)
    low, high = found.octree.volume_bounds()
    assert low < found.report.surface.volume < high
    # half of the solid, and half of what ten silhouettes leave around it, which is not the same on all sides
    assert 0.5 * VOLUME < found.report.surface.volume < 0.65 * VOLUME
    assert any("the box leaves out" in (line.message or "") for line in found.report.warnings)
    # what the box cuts is a plane, and is closed
    at_plane = found.mesh.xyz[:, 0] > -0.1 * found.octree.cell
    assert at_plane.any()
    assert (found.mesh.normal[at_plane, 0] > 0.3).all()
    edges = np.sort(found.mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()


def test_what_cannot_be_carved_is_refused(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert carve(photographs, "-o", tmp_path / "a", "--box", 3, 3, 3, 4, 4, 4) == 3
    assert "found none of it in there" in capsys.readouterr().err
    assert carve(photographs) == 2
    assert "give -o OUT" in capsys.readouterr().err
    folder = tmp_path / "inside"
    shutil.copytree(photographs, folder)
    document = json.loads((folder / "cameras.json").read_text())
    for camera in document["cameras"]:  # turned about: the object is behind
        turn = np.diag([-1.0, 1.0, -1.0])
        camera["R_w2c"] = (turn @ camera["R_w2c"]).tolist()
        camera["t_w2c"] = (turn @ camera["t_w2c"]).tolist()
    (folder / "cameras.json").write_text(json.dumps(document))
    assert carve(folder, "-o", tmp_path / "b") == 3
    assert "no place in common" in capsys.readouterr().err


def test_nothing_is_carved_through_the_hole_of_a_mask(photographs: Path, tmp_path: Path) -> None:
    folder = tmp_path / "hole"
    shutil.copytree(photographs, folder)
    path = folder / "images" / VIEWS[2].name
    rgba = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert rgba is not None
    rgba[38:50, 52:66] = 0
    cv2.imwrite(str(path), rgba)
    assert carve(folder, "-o", tmp_path / "mended") == 0
    report = json.loads((tmp_path / "mended" / "report.json").read_text())
    assert [one["name"] for one in report["tolerance"]["doubted"]] == [VIEWS[2].name]
    assert report["surface"]["volume"] > VOLUME
    assert carve(folder, "-o", tmp_path / "kept", "--keep-holes") == 0
    kept = json.loads((tmp_path / "kept" / "report.json").read_text())
    assert "tolerance" not in kept
    assert kept["surface"]["volume"] < 0.95 * report["surface"]["volume"]


@pytest.mark.parametrize("kind", ["turned", "moved"])
def test_a_camera_that_contradicts_all_others_is_named_and_carves_nothing(
    photographs: Path, tmp_path: Path, kind: str
) -> None:
    folder = tmp_path / kind
    shutil.copytree(photographs, folder)
    document = json.loads((folder / "cameras.json").read_text())
    camera = document["cameras"][4]
    if kind == "turned":
        turn = rigid3.rotation_matrix(np.array([0.0, np.sin(np.radians(2.5)), 0.0, np.cos(np.radians(2.5)), 0, 0, 0]))
        camera["R_w2c"] = (turn @ camera["R_w2c"]).tolist()
        camera["t_w2c"] = (turn @ camera["t_w2c"]).tolist()
    else:  # into the middle of the object
        camera["t_w2c"] = [0.05, 0.0, 0.1]
    (folder / "cameras.json").write_text(json.dumps(document))
    assert carve(folder, "-o", tmp_path / "c") == 0
    report = json.loads((tmp_path / "c" / "report.json").read_text())
    assert [mask["name"] for mask in report["masks"]["masks"] if mask["problem"]] == [VIEWS[4].name]
    assert any(VIEWS[4].name in line["message"] and "carves nothing" in line["message"] for line in report["warnings"])
    assert report["surface"]["volume"] > VOLUME


def test_damaged_octrees_are_named(tmp_path: Path) -> None:
    path = tmp_path / "octree.npz"
    path.write_bytes(b"PK nothing")
    with pytest.raises(InputError, match="expected an archive of low, side"):
        read_octree(path)
    np.savez(path, low=np.zeros(3), side=1.0, full=np.zeros(2, np.int64), level_starts=np.array([0, 2]), surface=[1])
    with pytest.raises(InputError, match="other arrays"):
        read_octree(path)


def test_the_page_shows_photographs_slices_and_levels(carved: Path) -> None:
    page = (carved / "report.html").read_text()
    assert page.count("data:image/jpeg") >= 3 * 4 + 3
    assert all(view.name in page for view in VIEWS)
    assert "a photograph from here" in page
    octree = read_octree(carved / "octree.npz")
    ends = (np.array([-0.8, -0.6, -0.5]), np.array([0.8, 0.6, 0.5]))
    # a slice across z: 1.6 to the right and 1.2 up, in a picture of 1.1 times 1.6; without and with the border's cells
    picture, truth = slice_picture(octree, 2, 0.0, ends), 1.6 * 1.2 / 1.76**2
    inked, border = (picture < 250).any(axis=2).mean(), (picture == [30, 34, 40]).all(axis=2).mean()
    assert 0.85 * truth < inked - border < 1.1 * truth
    assert truth < inked < 1.25 * truth


def test_cells_of_a_level_are_drawn_by_their_open_faces() -> None:
    # two cells of level 1 side by side along x, one full and one with a finest cell in it
    octree = Octree(np.zeros(3), 4.0, 2, (_codes(), _codes(0), _codes()), _codes(8))
    corners, rgb, faces = faces_of_level(octree, 1)
    assert len(corners) == len(rgb) == 4 * 10
    mesh = Mesh((corners + 2.0).astype(np.float64), faces, np.zeros(corners.shape, np.float32), rgb)
    assert face_areas(mesh.xyz, mesh.faces).sum() == pytest.approx(10 * 4.0)
    a, b, c = (mesh.xyz[mesh.faces[:, corner]] for corner in range(3))
    assert np.einsum("fc,fc->", a, np.cross(b, c)) / 6.0 == pytest.approx(16.0)  # outward all around
    assert len(faces_of_level(octree, 2)[2]) == 2 * (6 * 4 + 6 - 2)  # eight cells and one beside them


def _codes(*codes: int) -> np.ndarray:
    return np.array(codes, np.uint64)
