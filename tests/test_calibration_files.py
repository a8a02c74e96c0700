"""calibration.json and the camera files of other programs: written, read back by ours and by theirs."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from sfmapp.calibration.boards import Board, parse_board
from sfmapp.calibration.file import read_calibration_file
from sfmapp.calibration.printing import PAPERS, default_board, write_board
from sfmapp.calibration.result import CameraCalibration, ViewFit
from sfmapp.camera.camera import Camera, project
from sfmapp.camera.models import PARAM_NAMES
from sfmapp.camera.names import CameraModel
from sfmapp.camera_files.photographs import Photograph, read_given_cameras
from sfmapp.camera_files.reading import read_calibration
from sfmapp.cli.main import main
from sfmapp.errors import InputError, UsageError
from sfmapp.pipelines.calibration.results import write_camera
from sfmapp.scene.synthetic import synthetic_camera


def calibration_of(camera: Camera) -> CameraCalibration:
    num = len(camera.params)
    root = np.random.default_rng(3).normal(size=(num + 6, num + 6)) * np.logspace(0, -6, num + 6)[:, None]
    whole = root @ root.T
    xy = np.array([[10.0, 20.0], [30.0, 40.0]])
    view = ViewFit("a.jpg", np.array([0.0, 0.0, 0.0, 1.0, 0.1, 0.2, 0.9]), xy, xy * 0.01, np.array([True, False]))
    return CameraCalibration(
        camera, whole[:num, :num], "board", 0.11, 500, (view,), whole, (0.3, 0.5, 0.9), ("few views",)
    )


@pytest.mark.parametrize("model", CameraModel)
def test_a_camera_is_read_back_from_every_form_that_can_hold_it(tmp_path: Path, model: CameraModel) -> None:
    camera = synthetic_camera(model)
    made = calibration_of(camera)
    written = {one.name: one for one in write_camera(tmp_path, made)}
    assert written.keys() == {"cameras.txt", "opencv.yaml", "camchain.yaml", "camera_info.yaml"}
    for name, one in written.items():
        assert (tmp_path / name).is_file() == (one.reason is None)
        assert (one.max_px is None) == (one.reason is not None)
        assert one.max_px is None or one.max_px < 1e-8, (name, one)
    assert (written["cameras.txt"].reason is None) == model.is_colmaps
    read = read_calibration_file(tmp_path)
    np.testing.assert_array_equal(read.camera.params, camera.params)
    np.testing.assert_array_equal(read.covariance, made.covariance)
    np.testing.assert_array_equal(read.frame_covariance, made.frame_covariance)
    assert (read.noise_px, read.distances, read.warnings) == (made.noise_px, made.distances, made.warnings)
    path = str(tmp_path / "calibration.json")
    size = (camera.width, camera.height)
    (given,) = read_given_cameras(path).of_photographs("", [Photograph("a.jpg", size)])
    assert given.camera.model == model
    np.testing.assert_array_equal(given.camera.params, camera.params)
    np.testing.assert_array_equal(read_calibration(path, [size]).rig.cameras[0].params, camera.params)


def test_opencv_projects_with_its_file_where_our_camera_does(tmp_path: Path) -> None:
    rays = np.random.default_rng(1).uniform([-0.4, -0.3, 1.0], [0.4, 0.3, 1.0], (50, 3))
    for model in (CameraModel.OPENCV, CameraModel.FULL_OPENCV, CameraModel.OPENCV_THIN_PRISM):
        camera = synthetic_camera(model)
        write_camera(tmp_path, calibration_of(camera))
        storage = cv2.FileStorage(str(tmp_path / "opencv.yaml"), cv2.FILE_STORAGE_READ)
        matrix, coefficients = (storage.getNode(name).mat() for name in ("camera_matrix", "distortion_coefficients"))
        pixels = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, coefficients)[0][:, 0]
        np.testing.assert_allclose(pixels + 0.5, project(camera, rays), atol=1e-8)


def test_pycolmap_reads_the_camera(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    camera = synthetic_camera(CameraModel.FULL_OPENCV)
    write_camera(tmp_path, calibration_of(camera))
    (tmp_path / "images.txt").write_text("")
    (tmp_path / "points3D.txt").write_text("")
    (read,) = pycolmap.Reconstruction(str(tmp_path)).cameras.values()
    np.testing.assert_array_equal(read.params, camera.params)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"format": "other"}, "expected a calibration that sfmapp has written"),
        ({"params": [1.0, 2.0]}, "has 8 parameters, found 2"),
        ({"covariance": [[1.0]]}, "covariance: expected 8 x 8"),
        ({"covariance": (-np.eye(8)).tolist()}, "negative variance"),
        ({"distances": [0.0, 1.0, 2.0]}, "three numbers above zero"),
        ({"noise_px": "small"}, "noise_px"),
    ],
)
def test_a_damaged_calibration_is_refused(tmp_path: Path, change: dict[str, object], expected: str) -> None:
    write_camera(tmp_path, calibration_of(synthetic_camera(CameraModel.OPENCV)))
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(InputError, match=expected):
        read_calibration_file(path)


def test_sigmas_and_correlations_of_held_parameters() -> None:
    camera = synthetic_camera(CameraModel.SIMPLE_RADIAL)
    covariance = np.zeros((4, 4))
    covariance[:2, :2] = [[4.0, 1.0], [1.0, 1.0]]
    made = CameraCalibration(camera, covariance, "board", 0.1, 10)
    np.testing.assert_allclose(made.sigmas, [2.0, 1.0, 0.0, 0.0])
    np.testing.assert_allclose(made.correlations[:2, :2], [[1.0, 0.5], [0.5, 1.0]])
    assert made.param_names == PARAM_NAMES[camera.model]


# ------------------------------------------------------------------------------------------------------------- on paper


def drawn(path: Path, px_per_mm: float = 8.0) -> np.ndarray:
    """The shapes of an SVG as a picture."""
    root = ElementTree.parse(path).getroot()
    width, height = (float(value) for value in root.attrib["viewBox"].split()[2:])
    assert root.attrib["width"] == f"{width}mm"
    picture = np.full((round(height * px_per_mm), round(width * px_per_mm)), 255, np.uint8)
    for shape in root:
        at = {name: float(value) * px_per_mm for name, value in shape.attrib.items() if name != "font-family"}
        if shape.tag.endswith("rect"):
            x, y = round(at["x"]), round(at["y"])
            picture[y : round(at["y"] + at["height"]), x : round(at["x"] + at["width"])] = 0
        elif shape.tag.endswith("circle"):
            cv2.circle(picture, (round(at["cx"]), round(at["cy"])), round(at["r"]), 0, -1)
    return picture


def test_opencv_finds_what_is_printed(tmp_path: Path) -> None:
    path = tmp_path / "board.svg"
    write_board(path, parse_board("chessboard:9x6:0.025"), "A4")
    found, corners = cv2.findChessboardCorners(drawn(path), (9, 6))
    assert found
    # true size: 25 mm at 8 pixels a millimetre
    assert np.linalg.norm(corners[1] - corners[0]) == pytest.approx(200.0, abs=0.5)
    board = default_board("A3")
    write_board(path, board, "A3")
    theirs = cv2.aruco.CharucoBoard(
        (board.columns, board.rows), board.spacing, board.marker, cv2.aruco.getPredefinedDictionary(0)
    )
    ids = cv2.aruco.CharucoDetector(theirs).detectBoard(drawn(path, 4.0))[1]
    assert len(ids) == (board.columns - 1) * (board.rows - 1)
    write_board(path, parse_board("acircles:4x11:0.015"), "A4")
    assert cv2.findCirclesGrid(drawn(path), (4, 11), flags=cv2.CALIB_CB_ASYMMETRIC_GRID)[0]


def test_an_april_grid_has_kalibrs_layout(tmp_path: Path) -> None:
    path = tmp_path / "board.svg"
    board = parse_board("aprilgrid:6x4:0.03:0.3")
    write_board(path, board, "A4")
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = 2
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    corners, ids, _ = cv2.aruco.ArucoDetector(family, parameters).detectMarkers(drawn(path))
    centers = {int(i): c[0].mean(0) for i, c in zip(ids.ravel(), corners, strict=True)}
    assert sorted(centers) == list(range(24))
    # the first at the bottom left, the next to its right, the seventh above it; 39 mm apart
    np.testing.assert_allclose(centers[1] - centers[0], [312.0, 0.0], atol=1.0)
    np.testing.assert_allclose(centers[6] - centers[0], [0.0, -312.0], atol=1.0)


def test_a_pdf_is_as_large_as_its_paper(tmp_path: Path) -> None:
    path = tmp_path / "board.pdf"
    assert main(["calibrate", "print-board", "-o", str(path), "--paper", "letter", "-q"]) == 0
    data = path.read_bytes()
    assert data.startswith(b"%PDF-1.4")
    assert b"/MediaBox [0 0 792.0000 612.0000]" in data
    # the table of places leads to the objects
    table = data[int(data.split(b"startxref\n")[1].split()[0]) :].splitlines()
    for number, line in enumerate(table[3:7], 1):
        assert data[int(line[:10]) :].startswith(b"%d 0 obj" % number)


def test_what_does_not_fit_or_is_no_board_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"do not fit on A4"):
        write_board(tmp_path / "a.svg", parse_board("chessboard:9x6:0.05"), "A4")
    with pytest.raises(UsageError, match=r"ends in .svg or .pdf"):
        write_board(tmp_path / "a.png", default_board("A4"), "A4")
    for text in ("checkers:9x6:0.02", "chessboard:9:0.02", "charuco:5x7:0.02:0.03", "chessboard:9x6:-1", "circles:3x3"):
        with pytest.raises(UsageError, match="board"):
            parse_board(text)
    assert main(["calibrate", "print-board", "-o", str(tmp_path / "a.svg"), "--board", "chess:9x6:0.02"]) == 2
    assert set(PAPERS) == {"A4", "A3", "letter"}


def test_target_files_of_kalibr(tmp_path: Path) -> None:
    path = tmp_path / "target.yaml"
    path.write_text("target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 6\ntagSize: 0.088\ntagSpacing: 0.3\n")
    board = parse_board(str(path))
    assert board == Board("aprilgrid", 6, 6, 0.088, 0.3, "DICT_APRILTAG_36H11")
    assert parse_board(board.text()[: board.text().rindex(":")]) == board
    assert board.points.shape == (144, 3)
    np.testing.assert_allclose(board.points[4], [0.088 * 1.3, 0.0, 0.0])
    path.write_text("target_type: 'checkerboard'\ntargetCols: 6\ntargetRows: 7\n")
    with pytest.raises(InputError, match="rowSpacingMeters"):
        parse_board(str(path))
