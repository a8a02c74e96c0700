"""Poses from known points and what is measured with them: exact cases, oracles, sigmas that hold, and the commands."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.stats import chi2

from schemas import check_schema
from sfmapp.calibration.file import covariance_at
from sfmapp.calibration.locate import locate_camera
from sfmapp.calibration.measure import Plane, measure, place_by_homography, place_on_plane
from sfmapp.calibration.point_reports import read_pose
from sfmapp.calibration.result import CameraCalibration
from sfmapp.camera.camera import Camera, project
from sfmapp.camera.names import CameraModel
from sfmapp.camera_files.photographs import Photograph
from sfmapp.cli.main import main
from sfmapp.errors import InputError, NoReconstructionError, UsageError
from sfmapp.formats.known_points import read_known_points, read_marker_places, read_marks
from sfmapp.geometry import p3p, pnp, resection, rigid3
from sfmapp.pipelines.calibration.known_points import MeasureSource, measure_marks

SIZE = (1280, 720)
CAMERA = Camera(CameraModel.OPENCV, *SIZE, [900.0, 910.0, 630.0, 370.0, -0.2, 0.05, 0.001, -0.002])
FISHEYE = Camera(CameraModel.OPENCV_FISHEYE, 1000, 1000, [300.0, 300.0, 500.0, 500.0, 0.02, -0.01, 0.0, 0.0])
PANORAMA = Camera(CameraModel.EQUIRECTANGULAR, 2000, 1000, [2000.0, 1000.0])


def picture(rng, num: int, camera: Camera, *, is_flat: bool = False):
    """Places, pixels and the pose; all round a camera that sees so far."""
    rotation = rigid3.exp_so3(0.5 * rng.normal(size=3))
    if camera.is_wide:
        xyz = rng.normal(size=(4 * num, 3))
        xyz *= rng.uniform(1.0, 3.0, (4 * num, 1)) / np.linalg.norm(xyz, axis=1, keepdims=True)
        pose = rigid3.from_matrix(rotation, np.array([0.1, -0.1, 0.2]))
    else:
        xyz = rng.uniform(-1.0, 1.0, (4 * num, 3)) * [1.6, 1.0, 0.0 if is_flat else 0.8]
        pose = rigid3.from_matrix(rotation, np.array([*0.1 * rng.normal(size=2), 4.0]))
    xy = project(camera, rigid3.apply(pose, xyz))
    inside = np.flatnonzero(np.isfinite(xy).all(1) & (xy > 0).all(1) & (xy < [camera.width, camera.height]).all(1))[
        :num
    ]
    return xyz[inside], xy[inside], pose


def pose_error(found: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """(6,) turn and shift of ``x_cam <- exp(w) x_cam + v``."""
    turn = rigid3.log_so3(rigid3.rotation_matrix(found) @ rigid3.rotation_matrix(pose).T)
    return np.concatenate([turn, found[4:] - rigid3.exp_so3(turn) @ pose[4:]])


# --------------------------------------------------------------------------------------------------- all points at once


@pytest.mark.parametrize("num", [3, 4, 5, 50])
@pytest.mark.parametrize("is_flat", [False, True])
@pytest.mark.parametrize("camera", [CAMERA, PANORAMA])
def test_all_poses_of_exact_points_are_found(num, is_flat, camera) -> None:
    """The true one is always there, and the only one for more points than four; three have those that P3P has."""
    for seed in range(5):
        xyz, _, pose = picture(np.random.default_rng([0, seed]), num, camera, is_flat=is_flat)
        if is_flat and camera.is_wide:
            xyz[:, 2] = 0.0
        seen = rigid3.apply(pose, xyz)
        rays = seen / np.linalg.norm(seen, axis=1, keepdims=True)
        found = pnp.poses_of_points(xyz, rays)
        errors = [np.abs(pose_error(one, pose)).max() for one in found]
        assert min(errors) < 1e-6
        if num > 3:
            assert np.argmin(errors) == 0
        else:
            rotations, translations = np.empty((4, 3, 3)), np.empty((4, 3))
            count = p3p.poses_of_three(xyz, rays, rotations, translations)
            for k in range(count):
                assert min(np.abs(rigid3.rotation_matrix(one) - rotations[k]).max() for one in found) < 1e-5


def test_the_two_methods_go_through_one_interface() -> None:
    rng = np.random.default_rng(1)
    xyz, xy, pose = picture(rng, 30, PANORAMA)
    seen = rigid3.apply(pose, xyz)
    rays = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    for method in ("p3p", "all"):
        found = resection.estimate_pose(xyz, rays, 1e-3, method=method)
        assert found.num_inliers == 30
        assert np.abs(pose_error(found.cam_from_world, pose)).max() < 1e-6
    assert resection.estimate_pose(xyz * [1, 0, 0], rays, 1e-3, method="all") is None
    assert len(xy) == 30


# -------------------------------------------------------------------------------------------------------------- poses


@pytest.mark.parametrize("camera", [CAMERA, FISHEYE, PANORAMA])
@pytest.mark.parametrize("method", ["auto", "all"])
def test_exact_points_give_the_pose_exactly(camera, method) -> None:
    xyz, xy, pose = picture(np.random.default_rng(2), 12, camera)
    found = locate_camera(xyz, xy, camera, method=method)
    assert np.abs(pose_error(found.view.cam_from_world, pose)).max() < 1e-6
    assert not found.others
    assert (np.diag(found.covariance)[-6:] > 0.0).all()


def test_the_pose_is_the_one_that_opencv_and_pycolmap_refine_to() -> None:
    rng = np.random.default_rng(3)
    xyz, xy, _ = picture(rng, 40, CAMERA)
    xy = xy + 0.5 * rng.normal(size=xy.shape)
    found = locate_camera(xyz, xy, CAMERA)
    sigmas = np.sqrt(np.diag(found.covariance)[-6:])
    ok, rotation, translation = cv2.solvePnP(
        xyz, xy - 0.5, CAMERA.k_matrix - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]], CAMERA.params[4:],
        flags=cv2.SOLVEPNP_ITERATIVE,
    )  # fmt: skip
    assert ok
    theirs = rigid3.from_matrix(rigid3.exp_so3(rotation.ravel()), translation.ravel())
    assert (np.abs(pose_error(found.view.cam_from_world, theirs)) < 0.02 * sigmas).all()
    camera = pycolmap.Camera(model="OPENCV", width=SIZE[0], height=SIZE[1], params=CAMERA.params)
    answer = pycolmap.estimate_and_refine_absolute_pose(xy, xyz, camera)
    answer = pycolmap.refine_absolute_pose(
        answer["cam_from_world"], xy, xyz, np.ones(40, bool), camera,
        {"loss_function_scale": 1e6, "gradient_tolerance": 1e-12},
    )  # fmt: skip
    matrix = answer["cam_from_world"].matrix()
    theirs = rigid3.from_matrix(matrix[:, :3], matrix[:, 3])
    assert (np.abs(pose_error(found.view.cam_from_world, theirs)) < 0.02 * sigmas).all()


@pytest.mark.parametrize(("camera", "is_flat"), [(CAMERA, False), (CAMERA, True), (PANORAMA, False)])
def test_the_covariance_of_a_pose_holds(camera, is_flat) -> None:
    """NEES two-sided and three sigmas, with wrong points among the right ones, all of which are named."""
    nees, sigmas, names = 0.0, [], [0, 0]
    num_trials = 40
    for trial in range(num_trials):
        rng = np.random.default_rng([4, trial])
        xyz, xy, pose = picture(rng, 20, camera, is_flat=is_flat)
        xy = xy + 0.5 * rng.normal(size=xy.shape)
        wrong = rng.choice(20, trial % 4, replace=False)
        xy[wrong] += rng.uniform(15.0, 50.0, (len(wrong), 2))
        found = locate_camera(xyz, xy, camera)
        covariance, error = found.covariance[-6:, -6:], pose_error(found.view.cam_from_world, pose)
        nees += error @ np.linalg.solve(covariance, error)
        sigmas.append(error / np.sqrt(np.diag(covariance)))
        named = set(np.flatnonzero(~found.view.is_used))
        names[0], names[1] = names[0] + len(named - set(wrong)), names[1] + len(set(wrong) - named)
    assert chi2.ppf(1e-3, 6 * num_trials) < nees < chi2.ppf(1.0 - 1e-3, 6 * num_trials)
    # turn and shift go together: of forty poses, two beyond three sigmas are chance
    assert (np.abs(sigmas) < 3.0).all(1).sum() >= num_trials - 2
    assert names[0] <= 1
    assert names[1] == 0


def test_the_covariance_of_the_camera_moves_the_pose_along() -> None:
    spread = np.diag([4.0, 4.0, 5.0, 5.0, 1e-3, 1e-3, 1e-4, 1e-4]) ** 2
    nees, num_trials = 0.0, 40
    for trial in range(num_trials):
        rng = np.random.default_rng([5, trial])
        xyz, xy, pose = picture(rng, 20, CAMERA)
        off = CAMERA.with_params(CAMERA.params + np.sqrt(np.diag(spread)) * rng.normal(size=8))
        noisy = xy + 0.3 * rng.normal(size=xy.shape)
        found = locate_camera(xyz, noisy, off, sigma_px=0.3, camera_covariance=spread)
        joint = np.concatenate([off.params - CAMERA.params, pose_error(found.view.cam_from_world, pose)])
        nees += joint @ np.linalg.solve(found.covariance, joint)
    assert chi2.ppf(1e-3, 14 * num_trials) < nees < chi2.ppf(1.0 - 1e-3, 14 * num_trials)


def test_the_covariance_follows_a_camera_to_other_sizes_and_turns(tmp_path) -> None:
    """Of a photograph of half the size lengths have half the sigma; of one on its side, x and y have changed places."""
    rng = np.random.default_rng(17)
    root = rng.normal(size=(8, 8)) * np.array([3.0, 3, 2, 2, 0.01, 0.01, 1e-3, 1e-3])[:, None]
    made = CameraCalibration(CAMERA, root @ root.T, "", 1.0, 1)
    small = covariance_at(made, str(tmp_path), Photograph("a.jpg", (CAMERA.width // 2, CAMERA.height // 2)))
    scale = np.array([0.5, 0.5, 0.5, 0.5, 1, 1, 1, 1])
    np.testing.assert_allclose(small, made.covariance * scale * scale[:, None], rtol=1e-6)
    same = covariance_at(made, str(tmp_path), Photograph("a.jpg", (CAMERA.width, CAMERA.height)))
    np.testing.assert_allclose(same, made.covariance, rtol=1e-6)
    # sensor readings turned by EXIF: what was x of the upright pictures is y of the file, with or without its sign
    side = covariance_at(made, str(tmp_path), Photograph("a.jpg", (CAMERA.height, CAMERA.width), orientation=6))
    np.testing.assert_allclose(np.diag(side), np.diag(made.covariance)[[1, 0, 3, 2, 4, 5, 7, 6]], rtol=1e-6)
    assert np.linalg.slogdet(side)[1] == pytest.approx(np.linalg.slogdet(made.covariance)[1], rel=1e-6)


def test_a_second_pose_that_fits_as_well_is_told() -> None:
    """A small square far away can be tilted either way: of the pose that is wrong it is said that there is another."""
    square = np.array(
        [[-0.1, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0], [-0.1, 0.1, 0], [0.0, 0.02, 0], [0.05, -0.03, 0]]
    )
    told, away = 0, 0
    for trial in range(15):
        rng = np.random.default_rng([6, trial])
        pose = rigid3.from_matrix(rigid3.exp_so3([0.4, 0.3, 0.1]), np.array([0.1, 0.0, 5.0]))
        xy = project(CAMERA, rigid3.apply(pose, square)) + 0.3 * rng.normal(size=(6, 2))
        found = locate_camera(square, xy, CAMERA, sigma_px=0.3)
        is_wrong = np.abs(pose_error(found.view.cam_from_world, pose)[:3]).max() > 0.5
        away += is_wrong
        told += bool(found.others)
        assert found.others or not is_wrong
    assert told > away
    near = rigid3.from_matrix(rigid3.exp_so3([0.4, 0.3, 0.1]), np.array([0.0, 0.0, 0.4]))
    assert not locate_camera(square, project(CAMERA, rigid3.apply(near, square)), CAMERA, sigma_px=0.3).others


def test_what_tells_no_pose_is_refused_with_the_reason() -> None:
    rng = np.random.default_rng(7)
    xyz, xy, _ = picture(rng, 12, CAMERA)
    for places, pixels, message in (
        (xyz[:3], xy[:3], "at least 4"),
        (xyz[[0, 1, 2, 2]], xy[:4], "at least 4"),
        (xyz * [1, 0, 0], xy, "one line"),
        (np.where(xyz == xyz[0, 0], np.nan, xyz), xy, "finite"),
    ):
        with pytest.raises(InputError, match=message):
            locate_camera(places, pixels, CAMERA)
    with pytest.raises(NoReconstructionError, match="no pose agrees"):
        locate_camera(xyz, rng.uniform(0.0, 700.0, xy.shape), CAMERA, max_error_px=1.0)


# ---------------------------------------------------------------------------------------------------------- measuring

SHEET = np.array([[-0.5, -0.4, 0.0], [0.6, -0.5, 0.0], [0.7, 0.5, 0.0], [-0.4, 0.6, 0.0]])
FIGURES = [("edge", (0, 1)), ("sheet", (0, 1, 2, 3))]
EDGE, AREA = np.hypot(1.1, 0.1), 1.11


def test_exact_marks_give_lengths_and_areas_exactly() -> None:
    xyz, xy, pose = picture(np.random.default_rng(8), 12, CAMERA)
    location = locate_camera(xyz, xy, CAMERA)
    marks = project(CAMERA, rigid3.apply(pose, SHEET))
    by_pose = place_on_plane(
        marks, CAMERA, location.view.cam_from_world, location.covariance, Plane.of_points(SHEET[:3]), 1.0
    )  # fmt: skip
    known = np.array([[-1.0, -0.7, 0.0], [1.0, -0.7, 0.0], [1.0, 0.7, 0.0], [-1.0, 0.7, 0.0], [0.3, 0.2, 0.0]])
    by_known = place_by_homography(marks, (known[:, :2], project(CAMERA, rigid3.apply(pose, known))), 1.0, CAMERA)
    for placed in (by_pose, by_known):
        edge, sheet = measure(placed, FIGURES)
        assert edge.length.value == pytest.approx(EDGE, rel=1e-6)
        assert sheet.area.value == pytest.approx(AREA, rel=1e-6)
        assert min(edge.length.sigma, sheet.area.sigma) > 0.0


def test_sigmas_of_what_is_measured_hold() -> None:
    """With errors of marks, known points and camera; the shares of the variance are those of these."""
    spread = np.diag([3.0, 3.0, 4.0, 4.0, 0.005, 0.005, 5e-4, 5e-4]) ** 2
    known = np.array([[-1.0, -0.7, 0.0], [1.0, -0.7, 0.0], [1.0, 0.7, 0.0], [-1.0, 0.7, 0.0]])
    normal = []
    for trial in range(40):
        rng = np.random.default_rng([9, trial])
        xyz, xy, pose = picture(rng, 14, CAMERA)
        off = CAMERA.with_params(CAMERA.params + np.sqrt(np.diag(spread)) * rng.normal(size=8))

        def marked(places, pose=pose, rng=rng):
            return project(CAMERA, rigid3.apply(pose, places)) + 0.3 * rng.normal(size=(len(places), 2))

        found = locate_camera(
            xyz, xy + 0.3 * rng.normal(size=xy.shape), off, method="all", sigma_px=0.3, camera_covariance=spread
        )  # fmt: skip
        ground = Plane.of_equation(np.array([0.0, 0.0, 2.0]), 0.0)
        by_pose = place_on_plane(marked(SHEET), off, found.view.cam_from_world, found.covariance, ground, 0.3)
        by_known = place_by_homography(marked(SHEET), (known[:, :2], marked(known)), 0.3, CAMERA)
        row = []
        for placed in (by_pose, by_known):
            edge, sheet = measure(placed, FIGURES)
            assert 0.0 < edge.length.mark_share < 1.0
            row += [(edge.length.value - EDGE) / edge.length.sigma, (sheet.area.value - AREA) / sheet.area.sigma]
        normal.append(row)
    squares = (np.array(normal) ** 2).sum(0)
    assert (squares > chi2.ppf(5e-4, 40)).all()
    assert (squares < chi2.ppf(1.0 - 5e-4, 40)).all()


def test_what_cannot_be_measured_is_refused() -> None:
    pose = rigid3.from_matrix(rigid3.exp_so3([-1.4, 0.0, 0.0]), np.array([0.0, 0.3, 4.0]))
    ground = Plane.of_equation(np.array([0.0, 0.0, 1.0]), 0.0)
    sees_sky = np.array([[640.0, 600.0], [640.0, 10.0]])
    with pytest.raises(InputError, match="horizon"):
        place_on_plane(sees_sky, CAMERA, pose, np.eye(14), ground, 1.0)
    with pytest.raises(InputError, match="line"):
        place_by_homography(sees_sky, (SHEET[:, :2] * [1, 0], project(CAMERA, SHEET + np.array([0.0, 0.0, 4.0]))), 1.0)
    placed = place_on_plane(
        np.full((4, 2), 400.0), CAMERA, rigid3.from_matrix(np.eye(3), [0, 0, 4.0]), np.eye(14), ground, 1
    )
    with pytest.raises(InputError, match="two marks"):
        measure(placed, [("one", (0,))])


# ------------------------------------------------------------------------------------------------------ files, commands


def write_lines(path, lines):
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_tables_are_read_in_their_usual_forms(tmp_path) -> None:
    """The literature's example of a line: (0, 3, 4) inches seen at (56, 115)."""
    rows = ["0 3 4 56 115", "1 0 0 10 20"]
    for name, lines in {
        "plain": rows,
        "commas": ["# marked by hand", "X [in], Y [in], Z [in], u, v", *(row.replace(" ", ",") for row in rows)],
        "semicolons": ["name;x_in;y_in;z_in;u;v", *("p;" + row.replace(" ", ";") for row in rows[:1]), "q;1;0;0;10;20"],
    }.items():
        found = read_known_points(write_lines(tmp_path / name, lines))
        np.testing.assert_array_equal(found.xyz[0], [0.0, 3.0, 4.0])
        np.testing.assert_array_equal(found.xy, [[56.0, 115.0], [10.0, 20.0]])
        assert found.unit == ("units" if name == "plain" else "in")
    assert read_marks(write_lines(tmp_path / "m", ["a 1 2", "a 3 4", "b 5 6"])).figures == (("a", (0, 1)), ("b", (2,)))
    corners = [f"7 {k} {k} 0 1" for k in range(4)]
    assert read_marker_places(write_lines(tmp_path / "k", corners)).corners[7].shape == (4, 3)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["1 2 3"], "found 3"),
        (["0 3 4 56 115", "0 3 4 57 115"], "line 2.*line 1"),
        (["0 3 4 56 115", "0 3 inf 57 115"], "line 2.*finite"),
        (["0 3 4 56 115", "0 3 4 57"], "line 2.*5 fields"),
        (["x,y,u"], "column 'v'|names of columns only"),
        (["x [mm],y [m],z [m],u,v", "1,2,3,4,5"], "one unit"),
        ([], "found no line"),
    ],
)
def test_damaged_tables_are_refused_with_their_line(tmp_path, lines, message) -> None:
    with pytest.raises(InputError, match=message):
        read_known_points(write_lines(tmp_path / "points.csv", lines))


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    """A photograph of ArUco markers in three planes, by homographies of each, and tables of what is in it."""
    folder, rng = tmp_path_factory.mktemp("desk"), np.random.default_rng(10)
    camera = Camera(CameraModel.PINHOLE, 960, 720, [900.0, 900.0, 480.0, 360.0])
    pose = rigid3.from_matrix(rigid3.exp_so3([2.6, -0.3, 0.35]), np.array([0.0, 0.0, 6.0]))
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    image, lines, points = np.full((720, 960), 200, np.uint8), ["id,corner,X [dm],Y [dm],Z [dm]"], []
    for number in range(8):
        x, y = 1.1 * (number % 4) - 1.8, 1.3 * (number // 4) - 1.1
        z = 0.35 * ((3 * number) % 4)
        corners = np.array([[x, y + 0.8, z], [x + 0.8, y + 0.8, z], [x + 0.8, y, z], [x, y, z]])
        xy = project(camera, rigid3.apply(pose, corners))
        margin = project(
            camera, rigid3.apply(pose, corners + 0.1 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]))
        )
        cv2.fillConvexPoly(image, np.round(margin * 16).astype(np.int32), 255, cv2.LINE_AA, 4)
        tile = cv2.GaussianBlur(dictionary.generateImageMarker(number, 240), (0, 0), 1.5)
        square = np.array([[0, 0], [240, 0], [240, 240], [0, 240]], np.float32) - 0.5
        warp = cv2.getPerspectiveTransform(square, (xy - 0.5).astype(np.float32))
        cover = cv2.warpPerspective(np.full_like(tile, 255), warp, (960, 720))
        image = np.where(cover > 127, cv2.warpPerspective(tile, warp, (960, 720)), image)
        lines += [f"{number},{k},{c[0]:.6f},{c[1]:.6f},{c[2]:.6f}" for k, c in enumerate(corners)]
        points += [
            f"m{number}{k},{c[0]},{c[1]},{c[2]},{u:.2f},{v:.2f}"
            for k, (c, (u, v)) in enumerate(zip(corners, xy, strict=True))
        ]
    points[3], swapped = ",".join([*points[3].split(",")[:4], *points[17].split(",")[4:]]), points[3]
    points[17] = ",".join([*points[17].split(",")[:4], *swapped.split(",")[4:]])
    noisy = np.clip(image + rng.normal(size=image.shape), 0, 255).astype(np.uint8)
    assert cv2.imwrite(str(folder / "desk.png"), noisy)
    write_lines(folder / "markers.csv", lines)
    write_lines(folder / "points.csv", ["name,x_dm,y_dm,z_dm,u,v", *points])
    return folder, camera, pose


def run(capsys, *words) -> dict:
    code = main([*map(str, words), "--json"])
    document = json.loads(capsys.readouterr().out)
    assert document["exit_code"] == code
    return document


def test_calibrate_locate_and_measure_by_command(desk, tmp_path, capsys) -> None:
    folder, _, pose = desk
    photo, out = folder / "desk.png", tmp_path / "out"
    found = run(
        capsys, "calibrate", "target", photo, "--markers", folder / "markers.csv", "--dictionary", "DICT_4X4_50",
        "-o", out,
    )  # fmt: skip
    values = {p["name"]: (p["value"], p["sigma"]) for p in found["parameters"]}
    assert abs(values["fx"][0] - 900.0) < 4.0 * values["fx"][1]
    assert values["fx"][1] < 30.0
    assert found["fit"]["num_used"] >= 30
    assert (out / "report.html").read_text(encoding="utf-8").count("data:image/jpeg") == 1
    assert (out / "recording.rrd").stat().st_size > 10_000
    # the calibration is taken by the next command, with its covariance; two points that changed places are named
    where = tmp_path / "where"
    located = run(capsys, "locate", photo, "--points", folder / "points.csv", "--camera", out, "-o", where)
    assert {p["name"] for p in located["fit"]["points"] if not p["is_used"]} == {"m03", "m41"}
    assert located["fit"]["pose"]["unit"] == "dm"
    known = read_pose(where)
    error = pose_error(known.cam_from_world, pose)
    assert (np.abs(error) < 5.0 * np.sqrt(np.diag(known.covariance)[-6:])).all()
    # a marker measured on its own plane, which three of its corners tell
    corners = np.array([p["marked_px"] for p in located["fit"]["points"] if p["name"].startswith("m2")])
    marks = write_lines(tmp_path / "marks.csv", [f"marker {u} {v}" for u, v in corners])
    measured = run(capsys, "measure", marks, "--pose", where, "--plane", "m20,m21,m22")
    area = measured["figures"][0]["area"]
    assert abs(area["value"] - 0.64) < 4.0 * area["sigma"] < 0.1
    metric = write_lines(
        tmp_path / "metric.csv",
        [f"{x} {y} {u} {v}" for (x, y), (u, v) in zip([(0, 8), (8, 8), (8, 0), (0, 0)], corners, strict=True)],
    )
    assert run(capsys, "measure", marks, "--metric", metric)["figures"][0]["length"]["value"] == pytest.approx(32.0)


def test_several_photographs_are_calibrated_together(desk, tmp_path, capsys) -> None:
    """A table with a column image, one for each photograph, and markers: the same camera, and a pose each."""
    folder, rng = tmp_path / "photos", np.random.default_rng(16)
    folder.mkdir()
    xyz, _, _ = picture(rng, 24, CAMERA)
    rows, tables = ["image,name,x_m,y_m,z_m,u,v"], []
    while len(tables) < 3:
        pose = rigid3.from_matrix(rigid3.exp_so3(0.4 * rng.normal(size=3)), np.array([0.0, 0.0, 3.5]))
        xy = project(CAMERA, rigid3.apply(pose, xyz)) + 0.3 * rng.normal(size=(24, 2))
        if not (np.isfinite(xy).all() and (xy > 20).all() and (xy < [CAMERA.width - 20, CAMERA.height - 20]).all()):
            continue
        xy[5] += 15.0 * (len(tables) == 1)
        name = "abc"[len(tables)]
        assert cv2.imwrite(str(folder / f"{name}.png"), np.full((CAMERA.height, CAMERA.width), 128, np.uint8))
        lines = [f"p{n},{x:.6f},{y:.6f},{z:.6f},{u:.3f},{v:.3f}" for n, ((x, y, z), (u, v)) in
                 enumerate(zip(xyz, xy, strict=True))]  # fmt: skip
        rows += [f"{name}.png,{line}" for line in lines]
        tables.append(write_lines(tmp_path / f"{name}.csv", ["name,x_m,y_m,z_m,u,v", *lines]))
    table = write_lines(tmp_path / "all.csv", rows)
    found = run(capsys, "calibrate", "target", folder, "--points", table, "-o", tmp_path / "one", "--no-recording")
    check_schema("calibrate-targets", json.loads((tmp_path / "one" / "report.json").read_text(encoding="utf-8")))
    values = {p["name"]: (p["value"], p["sigma"]) for p in found["parameters"]}
    for name, truth in zip(("fx", "fy", "cx", "cy"), CAMERA.params, strict=False):
        assert abs(values[name][0] - truth) < 4.0 * values[name][1]
    wrong = [(one["photograph"], p["name"]) for one in found["photographs"] for p in one["points"] if not p["is_used"]]
    assert wrong == [("b.png", "p5")]
    assert read_pose(tmp_path / "one" / "poses" / "c.json").unit == "m"
    with pytest.raises(InputError, match="those of 3"):
        read_pose(tmp_path / "one")
    photos = sorted(folder.iterdir())
    same = run(capsys, "calibrate", "target", *photos, "--points", *tables, "-o", tmp_path / "two", "--no-recording")
    assert same["parameters"] == found["parameters"]
    # one photograph of the table alone, and a name that it does not have
    alone = run(capsys, "calibrate", "target", photos[1], "--points", table, "-o", tmp_path / "b", "--no-recording")
    assert [p["name"] for p in alone["fit"]["points"] if not p["is_used"]] == ["p5"]
    (folder / "d.png").write_bytes(photos[0].read_bytes())
    assert main(["calibrate", "target", str(folder / "d.png"), "--points", str(table), "-o", str(tmp_path / "d")]) == 3
    assert "found those of a.png, b.png, c.png" in capsys.readouterr().err
    words = ["calibrate", "target", *photos[:2], "--points", tables[0], "-o", tmp_path / "e"]
    assert main(list(map(str, words))) == 2
    assert "column image" in capsys.readouterr().err
    # markers with known places, seen twice
    twice = tmp_path / "twice"
    twice.mkdir()
    for name in ("1.png", "2.png"):
        (twice / name).write_bytes((desk[0] / "desk.png").read_bytes())
    markers = run(
        capsys, "calibrate", "target", twice, "--markers", desk[0] / "markers.csv", "--dictionary", "DICT_4X4_50",
        "-o", tmp_path / "markers", "--no-recording",
    )  # fmt: skip
    focal = {p["name"]: (p["value"], p["sigma"]) for p in markers["parameters"]}["fx"]
    assert abs(focal[0] - 900.0) < 4.0 * focal[1] < 100.0


def test_commands_say_what_is_missing(desk, tmp_path, capsys) -> None:
    folder, _, _ = desk
    photo, points = folder / "desk.png", folder / "points.csv"
    for code, words in (
        (2, ["calibrate", "target", photo, "-o", tmp_path / "a"]),
        (2, ["calibrate", "target", photo, "--markers", folder / "markers.csv", "-o", tmp_path / "b"]),
        (3, ["calibrate", "target", folder / "gone.png", "--points", points, "-o", tmp_path / "c"]),
        (3, ["locate", photo, "--points", folder / "gone.csv", "--camera", "gone.json", "-o", tmp_path / "d"]),
        (2, ["measure", folder / "marks.csv"]),
        (3, ["measure", points, "--pose", folder / "markers.csv"]),
    ):
        assert main(list(map(str, words))) == code
    assert "sfmapp:" in capsys.readouterr().err
    with pytest.raises(UsageError, match="sigma_px"):
        measure_marks(points, MeasureSource(), sigma_px=-1.0)
