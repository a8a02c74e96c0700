"""``sfmapp stereo`` from the command line, on small pairs whose disparities are known."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from schemas import check_schema
from sfmapp.camera.camera import Camera, project
from sfmapp.camera.names import CameraModel
from sfmapp.camera_files.reading import read_calibration
from sfmapp.camera_files.rectified_writing import CAMERA_FILES, RectifiedCameras, write_rectified_files
from sfmapp.cli.main import main
from sfmapp.errors import InputError
from sfmapp.formats.colmap import write_model
from sfmapp.formats.disparity_files import read_disparity
from sfmapp.formats.middlebury_calibration import MiddleburyCalibration, write_middlebury
from sfmapp.formats.ply_reader import read_ply_geometry
from sfmapp.geometry import rigid3
from sfmapp.geometry.geodesy import LocalFrame
from sfmapp.georeference.world_frame import Georeference, ModelPlace, write_georeference
from sfmapp.pipelines.metres import metre_sigma_of_run
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.rig import Rig
from sfmapp.scene.tracks import Tracks
from sfmapp.stereo import prepare
from sfmapp.stereo.depth import depth_of_disparity
from sfmapp.stereo.prepare import PairCameras, prepare_pair
from sfmapp.stereo.rectification import plan_rectification, rectified_as_is, rectify
from sfmapp.stereo.sparse_matches import match_pictures
from sfmapp.stereo.uncertainty import depth_sigma
from sfmapp.workspace.layout import FORMAT

Pixels = NDArray[np.uint8]
NEAR, FAR = 24, 12
CALIBRATION = MiddleburyCalibration(200.0, 119.5, 79.5, 0.0, 0.1, 240, 160)


def texture(rng: np.random.Generator, shape: tuple[int, int]) -> Pixels:
    noise = cv2.GaussianBlur(rng.normal(0.0, 1.0, shape), (0, 0), 1.2)
    return np.clip(128.0 + 200.0 * noise, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A square at a disparity of 24 px before a wall at 12 px."""
    folder, rng = tmp_path_factory.mktemp("pair"), np.random.default_rng(3)
    wall, square = texture(rng, (160, 300)), texture(rng, (70, 80))
    left, right = (wall[:, 30 - shift : 270 - shift].copy() for shift in (0, -FAR))
    left[45:115, 100:180] = square
    right[45:115, 100 - NEAR : 180 - NEAR] = square
    for name, picture in (("left.png", left), ("right.png", right)):
        cv2.imwrite(str(folder / name), picture)
    write_middlebury(folder / "calib.txt", CALIBRATION)
    return folder / "left.png", folder / "right.png"


def run(*args: object) -> int:
    return main(["stereo", *map(str, args), "-q"])


def test_a_calibrated_pair_becomes_depths(pair: tuple[Path, Path], tmp_path: Path) -> None:
    assert run(*pair, "--camera", pair[0].parent / "calib.txt", "-o", tmp_path / "out") == 0
    disparity, depth = (np.load(tmp_path / "out" / name) for name in ("disparity.npy", "depth.npy"))
    assert np.nanmedian(disparity[60:100, 120:160]) == pytest.approx(NEAR, abs=0.2)
    assert np.nanmedian(disparity[:30, 60:]) == pytest.approx(FAR, abs=0.2)
    assert np.nanmedian(depth[60:100, 120:160]) == pytest.approx(200.0 * 0.1 / NEAR, rel=0.01)
    sigma, confidence = (np.load(tmp_path / "out" / name) for name in ("depth_sigma.npy", "confidence.npy"))
    np.testing.assert_array_equal(np.isfinite(sigma), np.isfinite(depth) & (confidence > 0.0))
    xyz = read_ply_geometry(tmp_path / "out" / "cloud.ply").xyz
    assert np.median(xyz[:, 2]) == pytest.approx(200.0 * 0.1 / FAR, rel=0.02)
    np.testing.assert_array_equal(read_disparity(tmp_path / "out" / "disparity.pfm"), disparity)
    assert {"view.glb", "report.html", "recording.rrd"} <= {path.name for path in (tmp_path / "out").iterdir()}
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    check_schema("stereo", report)
    (told,) = report["pairs"]
    assert told["rectification"]["is_as_given"]
    assert told["rectification"]["rows"]["rms_px"] < 0.3
    assert told["disparity"]["density"] > 0.7
    assert told["disparity"]["searched"][0] <= FAR <= NEAR <= told["disparity"]["searched"][1]


def test_a_baseline_may_have_a_unit(pair: tuple[Path, Path], tmp_path: Path) -> None:
    depths = []
    for baseline in ("10cm", "0.1"):
        assert run(*pair, "--focal", "200", "--baseline", baseline, "-o", tmp_path / baseline) == 0
        depths.append(np.load(tmp_path / baseline / "depth.npy"))
    np.testing.assert_array_equal(*depths)
    assert np.nanmedian(depths[0][60:100, 120:160]) == pytest.approx(200.0 * 0.1 / NEAR, rel=0.01)


def test_folders_of_pairs(pair: tuple[Path, Path], tmp_path: Path) -> None:
    for side, path in zip(("l", "r"), pair, strict=True):
        (tmp_path / side).mkdir()
        for name in ("a.png", "b.png"):
            (tmp_path / side / name).write_bytes(path.read_bytes())
    (tmp_path / "r" / "b.png").write_bytes((tmp_path / "l" / "b.png").read_bytes())  # one photograph twice
    assert run(tmp_path / "l", tmp_path / "r", "-o", tmp_path / "out") == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert [told["name"] for told in report["pairs"]] == ["a"]
    assert report["failed"][0]["name"] == "b"
    assert "same picture" in report["failed"][0]["reason"]
    assert (tmp_path / "out" / "a" / "disparity.npy").is_file()
    assert not (tmp_path / "out" / "a" / "depth.npy").exists()  # no baseline
    assert not (tmp_path / "out" / "a" / "cloud.ply").exists()
    page = (tmp_path / "out" / "report.html").read_text()
    assert 'href="a/report.html"' in page
    assert "same picture" in page
    assert "there are disparities, and no depths" in (tmp_path / "out" / "a" / "report.html").read_text()


def test_bad_input_is_named(pair: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    left, right = pair
    blank, small = tmp_path / "blank.png", tmp_path / "small.png"
    cv2.imwrite(str(blank), np.full((160, 240), 90, np.uint8))
    cv2.imwrite(str(small), cv2.imread(str(right), 0)[:100])
    calibration = left.parent / "calib.txt"
    cases: list[tuple[list[object], int, str]] = [
        ([right, left], 3, "left and right are swapped"),
        ([right, left, "--camera", calibration], 3, "left and right are swapped"),
        ([left, left], 3, "same picture"),
        ([left, blank], 3, "one brightness"),
        ([left, small], 0, "have different sizes"),
        ([left, small, "--camera", calibration], 3, "240"),
        ([left], 2, "expected two photographs"),
        ([left, tmp_path], 2, "expected two photographs"),
        ([left, tmp_path / "gone.png"], 3, "found nothing there"),
        ([left, right, "--baseline", "0.1"], 2, "need the focal length"),
        ([left, right, "--focal", "-3"], 2, "expected more than 0"),
        ([left, right, "--focal", "200", "--baseline", "10furlongs"], 2, "expected a number and its unit"),
        ([left, right, "--camera", calibration, "--focal", "3"], 2, "both say"),
        ([left, right, "--window", "4"], 2, "odd"),
    ]
    for n, (args, code, message) in enumerate(cases):
        assert run(*args, "-o", tmp_path / f"out{n}") == code, args
        assert message in capsys.readouterr().err, args


def test_middlebury_calibration_comes_back(tmp_path: Path) -> None:
    write_middlebury(tmp_path / "calib.txt", MiddleburyCalibration(995.0, 311.2, 254.9, 31.1, 0.193, 741, 500, 70))
    rig = read_calibration(tmp_path / "calib.txt", [(741, 500)] * 2).rig
    assert rig.cameras[0].canonical[:4].tolist() == [995.0, 995.0, 311.7, 255.4]
    assert rig.cameras[1].canonical[2] == pytest.approx(342.8)
    assert rig.cam_from_rig[1, 4:].tolist() == [-0.193, 0.0, 0.0]
    text = (tmp_path / "calib.txt").read_text()
    for bad in (text.replace("baseline", "base"), text.replace("doffs=31.1", "doffs=5"), text.replace("0 0 1]", "1]")):
        (tmp_path / "bad.txt").write_text(bad)
        with pytest.raises(InputError, match=r"bad\.txt"):
            read_calibration(tmp_path / "bad.txt", [(741, 500)] * 2)


def test_rows_of_a_rectified_pair_come_together_and_disparities_stay(pair: tuple[Path, Path], tmp_path: Path) -> None:
    left, right = (cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in pair)
    lowered = cv2.warpAffine(right, np.array([[1.0, 0.0, 0.0], [0.004, 1.0, 0.3]]), (240, 160), flags=cv2.INTER_CUBIC)
    cv2.imwrite(str(tmp_path / "right.png"), lowered)
    calibration = pair[0].parent / "calib.txt"
    for how in ("auto", "turn", "no"):
        out = tmp_path / how
        assert run(pair[0], tmp_path / "right.png", "--camera", calibration, "--correct", how, "-o", out) == 0
        (told,) = json.loads((out / "report.json").read_text())["pairs"]
        found, rows = told["rectification"]["misalignment"], told["rectification"]["rows"]
        assert found["is_significant"]
        assert found["rms_before_px"] > 0.4 > 0.15 > found["rms_after_px"]
        assert found["is_corrected"] == (how != "no")
        assert (rows["rms_px"] < 0.25) == (how != "no")
        assert np.array_equal(cv2.imread(str(out / "left.png"), cv2.IMREAD_GRAYSCALE), left)
        if how == "auto":
            disparity = np.load(out / "disparity.npy")
            assert np.nanmedian(disparity[60:100, 120:160]) == pytest.approx(NEAR, abs=0.2)
            assert np.nanmedian(disparity[:30, 60:]) == pytest.approx(FAR, abs=0.2)


def test_several_pairs_tell_one_turn_of_their_rig(
    pair: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls, made = [], []
    monkeypatch.setattr(prepare, "match_pictures", lambda *pictures: calls.append(1) or match_pictures(*pictures))
    monkeypatch.setattr(prepare, "rectify", lambda *pictures: made.append(1) or rectify(*pictures))
    left, right = (cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in pair)
    lower = np.array([[1.0, 0.0, 0.0], [0.004, 1.0, 0.3]])
    (tmp_path / "l").mkdir()
    (tmp_path / "r").mkdir()
    for name, rows in (("a.png", slice(None)), ("b.png", slice(None, None, -1))):  # the second upside down
        cv2.imwrite(str(tmp_path / "l" / name), left[rows])
        lowered = cv2.warpAffine(right[rows], lower, (240, 160), flags=cv2.INTER_CUBIC)
        cv2.imwrite(str(tmp_path / "r" / name), lowered)
    calibration = pair[0].parent / "calib.txt"
    assert run(tmp_path / "l" / "a.png", tmp_path / "r" / "a.png", "--camera", calibration, "-o", tmp_path / "one") == 0
    calls.clear()
    made.clear()
    assert run(tmp_path / "l", tmp_path / "r", "--camera", calibration, "-o", tmp_path / "both") == 0
    # no pair is rectified or matched twice, for its turn and for its rows after it
    assert (len(calls), len(made)) == (2, 2)
    (alone,) = json.loads((tmp_path / "one" / "report.json").read_text())["pairs"]
    told = json.loads((tmp_path / "both" / "report.json").read_text())["pairs"]
    first, second = (one["rectification"]["misalignment"] for one in told)
    assert first["turn_deg"] == second["turn_deg"]
    assert first["num_matches"] > 1.5 * alone["rectification"]["misalignment"]["num_matches"]
    assert first["is_corrected"]
    assert second["is_corrected"]
    assert max(one["rectification"]["rows"]["rms_px"] for one in told) < 0.25


def write_a_model(folder: Path, photographs: Path, pair: tuple[Path, Path]) -> None:
    """Two cameras of one row, and one in front of the first; thirty points in a plane, seen by all."""
    photographs.mkdir()
    for path in (*pair, pair[0]):
        name = path.name if not (photographs / path.name).exists() else "again.png"
        (photographs / name).write_bytes(path.read_bytes())
    camera = Camera(CameraModel.PINHOLE, 240, 160, np.array([200.0, 200.0, 120.0, 80.0]))
    points = np.random.default_rng(4).uniform((-0.6, -0.4, 1.6), (0.8, 0.4, 1.8), (30, 3))
    poses = np.tile(rigid3.IDENTITY, (3, 1))
    poses[1, 4], poses[2, 6] = -0.1, -0.3
    seen = [project(camera, rigid3.apply(pose, points)) for pose in poses]
    tracks = Tracks.from_observations(np.tile(np.arange(30), 3), np.repeat(np.arange(3), 30), np.concatenate(seen))
    model = Reconstruction.empty([camera], ["left.png", "right.png", "again.png"], np.zeros(3, np.int32), tracks)
    model.cam_from_world[:], model.point_xyz[:], model.obs_is_inlier[:] = poses, points, True
    write_model(folder, model)


def test_pairs_out_of_a_track_have_its_metres(pair: tuple[Path, Path], tmp_path: Path) -> None:
    write_a_model(tmp_path / "out" / "sparse" / "0", tmp_path / "frames", pair)
    for source, sigma in (("stereo", 0.05), ("none", None)):
        facts = {"scale_source": source, "scale_sigma": sigma, "contradictions": []}
        manifest = {"format": FORMAT, "command": "odometry", "source": str(tmp_path / "frames"),
                    "stages": {"odometry": {"is_done": True, "maps": [facts]}}}  # fmt: skip
        (tmp_path / "out" / "run.json").write_text(json.dumps(manifest))
        assert run(tmp_path / "out", "--pair", "left", "right", "-o", tmp_path / source) == 0
        (told,) = json.loads((tmp_path / source / "report.json").read_text())["pairs"]
        assert told["rectification"]["unit"] == ("m" if sigma else "")
        folder = tmp_path / source / told["name"]
        depth, error = (np.load(folder / f"{name}.npy") for name in ("depth", "depth_sigma"))
        assert np.nanmedian(depth) == pytest.approx(200.0 * 0.1 / FAR, rel=0.02)
        # 5 % of the metres are most of what is not known of depths
        assert (np.nanmedian(error / depth) > 0.05) == (source == "stereo")
    (tmp_path / "out" / "run.json").write_text(json.dumps({**manifest, "source": str(tmp_path / "film.mp4")}))
    assert run(tmp_path / "out", "--best", "1", "-o", tmp_path / "film") == 3


def test_pairs_out_of_a_model_and_out_of_a_video(pair: tuple[Path, Path], tmp_path: Path) -> None:
    folder, photographs = tmp_path / "sparse" / "0", tmp_path / "images"
    write_a_model(folder, photographs, pair)
    (folder / "images").symlink_to(photographs)
    assert run(folder, "--best", "1", "-o", tmp_path / "best") == 0
    report = json.loads((tmp_path / "best" / "report.json").read_text())
    assert {report["pairs"][0]["left"], report["pairs"][0]["right"]} == {"left.png", "right.png"}
    assert np.nanmedian(np.load(tmp_path / "best" / report["pairs"][0]["name"] / "disparity.npy")) > FAR - 1
    assert run(folder, "--pair", "right", "left.png", "-o", tmp_path / "named") == 0  # the model knows their order
    (told,) = json.loads((tmp_path / "named" / "report.json").read_text())["pairs"]
    assert told["rectification"]["is_swapped"]
    assert told["rectification"]["unit"] == ""
    written = {path.name for path in (tmp_path / "named" / told["name"]).iterdir()}
    assert written & set(CAMERA_FILES) == {"rectification.yaml"}  # the others have lengths in metres
    assert run(folder, "--pair", "left", "nobody", "-o", tmp_path / "none") == 3
    assert run(folder, "--pair", "left", "again", "-o", tmp_path / "ahead") == 3  # one in front of the other

    av = pytest.importorskip("av")
    both = np.concatenate([cv2.imread(str(path)) for path in pair], axis=1)[..., ::-1]
    with av.open(str(tmp_path / "film.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=10)
        stream.width, stream.height, stream.pix_fmt = 480, 160, "bgr0"
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(both), "rgb24")))
        container.mux(stream.encode())
    calibration = pair[0].parent / "calib.txt"
    assert run(tmp_path / "film.mkv", "--camera", calibration, "--step", "2", "-o", tmp_path / "film") == 0
    report = json.loads((tmp_path / "film" / "report.json").read_text())
    assert [told["name"] for told in report["pairs"]] == ["000000", "000002"]
    assert np.nanmedian(np.load(tmp_path / "film" / "000002" / "disparity.npy")) == pytest.approx(FAR, abs=0.2)


def test_metres_are_those_of_the_run_that_made_the_model(tmp_path: Path) -> None:
    assert metre_sigma_of_run(tmp_path) is None
    untold = {"model": 0, "reason": "too few", "bars": [], "findings": []}
    other = {"model": 1, "reason": "", "metres_per_unit": 0.4, "sigma_share": 0.01, "bars": [], "findings": []}
    report: dict[str, object] = {"stages": {"units": {"scales": [untold, other], "levels": []}}}
    (tmp_path / "report.json").write_text(json.dumps(report))
    assert metre_sigma_of_run(tmp_path) is None
    report["stages"] = {"units": {"scales": [{**other, "model": 0}], "levels": []}}
    (tmp_path / "report.json").write_text(json.dumps(report))
    assert metre_sigma_of_run(tmp_path) == 0.01
    points = [{"xyz_m": [10.0 * x, 0.0, 1.0], "role": "control"} for x in (-1.0, 1.0)]
    points.append({"xyz_m": [900.0, 0.0, 0.0], "role": "refuted"})  # it does not hold the model
    on_control = {"model": 0, "reason": "", "points": points, "summary": {"expected_horizontal_m": 0.02}}
    report["stages"] = {"control": {"models": [on_control]}}
    (tmp_path / "report.json").write_text(json.dumps(report))
    assert metre_sigma_of_run(tmp_path) == pytest.approx(0.002)
    report["stages"] = {"control": {"models": [{**on_control, "reason": "too few"}]}}
    (tmp_path / "report.json").write_text(json.dumps(report))
    assert metre_sigma_of_run(tmp_path) is None
    place = ModelPlace(
        model=0, source="gps", scale=1.0, rotation=(0.0, 0.0, 0.0, 1.0), translation_m=(0.0, 0.0, 0.0),
        scale_sigma_share=0.2, rotation_sigma_deg=(0.1, 0.1, 0.1), position_sigma_m=(1.0, 1.0, 2.0),
        common_offset_sigma_m=(0.0, 0.0, 0.0),
    )  # fmt: skip
    write_georeference(tmp_path, Georeference.about(LocalFrame(48.0, 8.0, 100.0), "ellipsoidal", [place]))
    assert metre_sigma_of_run(tmp_path) == 0.2


def test_lengths_that_are_told_to_a_share_tell_depths_to_it(pair: tuple[Path, Path]) -> None:
    left, right = (cv2.imread(str(path)) for path in pair)
    camera = Camera(CameraModel.PINHOLE, 240, 160, np.array([200.0, 200.0, 120.0, 80.0]))
    rig = Rig((camera, camera), np.array([rigid3.IDENTITY, [0.0, 0.0, 0.0, 1.0, -0.1, 0.0, 0.0]]))
    g = prepare_pair(left, right, PairCameras(rig, length_sigma=0.05, is_adjusted=True), ("l", "r")).pair.geometry
    assert g is not None
    assert float(depth_sigma(g, FAR, 0.0) / depth_of_disparity(FAR, g)) == pytest.approx(0.05)


def test_cameras_for_other_programs_come_back(tmp_path: Path) -> None:
    turn = rigid3.exp_so3(np.radians([0.5, -4.0, 1.0]))
    pose = rigid3.from_matrix(turn, -turn @ [0.2, 0.01, 0.0])
    lens = np.array([300.0, 301.0, 161.0, 119.0, -0.1, 0.02, 1e-3, -5e-4])
    rig = Rig((Camera(CameraModel.OPENCV, 320, 240, lens),) * 2, np.array([rigid3.IDENTITY, pose]))
    plan = plan_rectification(rig)
    g = plan.geometry
    assert g.baseline is not None
    rotations = np.stack([plan.left_from_camera, plan.right_from_camera])
    cameras = RectifiedCameras(rig, rotations, g.focal, g.cx, g.cy, g.doffs, g.baseline, (g.width, g.height))
    assert [path.name for path in write_rectified_files(tmp_path, cameras)] == list(CAMERA_FILES)

    stored = cv2.FileStorage(str(tmp_path / "rectification.yaml"), cv2.FILE_STORAGE_READ)
    matrix = {name: stored.getNode(name).mat() for name in ("M1", "D1", "M2", "D2", "R1", "R2", "P1", "P2", "Q")}
    points = np.random.default_rng(5).uniform((-0.5, -0.4, 1.5), (0.7, 0.4, 5.0), (50, 3))
    flat = []
    for side in (0, 1):  # what OpenCV makes of pixels with these is what the plan does
        xy = project(rig.cameras[side], rigid3.apply(rig.cam_from_rig[side], points))
        k, d, r, p = (matrix[f"{name}{side + 1}"] for name in "MDRP")
        flat.append(cv2.undistortPoints(xy[:, None] - 0.5, k, d, R=r, P=p, criteria=(3, 100, 1e-12))[:, 0])
        np.testing.assert_allclose(flat[side] + 0.5, plan.points(side, xy), atol=1e-5)
    found = cv2.perspectiveTransform(np.column_stack([flat[0], flat[0][:, 0] - flat[1][:, 0]])[None], matrix["Q"])[0]
    np.testing.assert_allclose(found, points @ plan.left_from_camera.T, atol=1e-4)

    again = rectified_as_is(read_calibration(tmp_path / "calib.txt", [(g.width, g.height)] * 2).rig)
    assert again is not None
    assert (again.focal, again.doffs, again.baseline) == pytest.approx((g.focal, g.doffs, g.baseline))
    one = read_calibration(tmp_path / "left.yaml", [(320, 240)]).rig.cameras[0]
    assert one.canonical[:8] == pytest.approx(lens)
