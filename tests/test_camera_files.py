"""Calibration files in the forms that people have them, against OpenCV."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfmapp.camera.camera import Camera, CameraModel, project
from sfmapp.camera_files.opencv_lens import FullLens, camera_from_opencv, sampling_map
from sfmapp.camera_files.photographs import Photograph, read_given_cameras
from sfmapp.camera_files.reading import read_calibration
from sfmapp.errors import InputError
from sfmapp.formats.flat_yaml import parse_flat_yaml
from sfmapp.geometry import rigid3

SIZE = (640, 480)
MATRIX = np.array([[500.0, 0, 319.0], [0, 501.0, 239.0], [0, 0, 1]])
LENS = np.array([-0.28, 0.07, 0.0002, -0.0003])
RAYS = np.stack([*np.meshgrid(np.linspace(-0.5, 0.5, 7), np.linspace(-0.4, 0.4, 5)), np.ones((5, 7))], -1).reshape(
    -1, 3
)


def assert_is_opencvs(camera: Camera, lens: np.ndarray = LENS, atol: float = 1e-9) -> None:
    """Points land where cv2.projectPoints has them, half a pixel on."""
    expected = cv2.projectPoints(RAYS, np.zeros(3), np.zeros(3), MATRIX, lens)[0].reshape(-1, 2) + 0.5
    np.testing.assert_allclose(project(camera, RAYS), expected, atol=atol)


ROS = """\
image_width: 640
image_height: 480
camera_name: head_camera
camera_matrix:
  rows: 3
  cols: 3
  data: [500, 0, 319, 0, 501, 239, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.28, 0.07, 0.0002, -0.0003, 0]
projection_matrix: {rows: 3, cols: 4, data: [480, 0, 320, 0, 0, 480, 240, 0, 0, 0, 1, 0]}
"""
EUROC = """\
# general
sensor_type: camera
resolution: [640, 480]
camera_model: pinhole
intrinsics: [500, 501, 319, 239] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 0.0002, -0.0003]
"""
ORB_SLAM = """\
%YAML:1.0
#---------------
Camera.type: "PinHole"
Camera.fx: 500.
Camera.fy: 501.0
Camera.cx: 319
Camera.cy: 239
Camera.k1: -0.28
Camera.k2: 0.07
Camera.p1: 0.0002
Camera.p2: -0.0003
Camera.width: 640
Camera.height: 480
"""
NUMBERS = {"fx": 500, "fy": 501, "cx": 319, "cy": 239, "k1": -0.28, "k2": 0.07, "p1": 0.0002, "p2": -0.0003}


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("camera_info.yaml", ROS),
        ("sensor.yaml", EUROC),
        ("orb.yaml", ORB_SLAM),
        ("calib.json", json.dumps(NUMBERS | {"width": 640, "height": 480})),
        ("calib.json", json.dumps(NUMBERS)),
        ("calib.json", json.dumps({"K": MATRIX.tolist(), "dist": LENS.tolist(), "image_size": [640, 480]})),
        (
            "calib.json",
            json.dumps({"intrinsics": {"fx": 500, "fy": 501, "cx": 319, "cy": 239}, "distortion": LENS.tolist()}),
        ),
        ("calib.json", json.dumps({"cam0": {"K": MATRIX.ravel().tolist(), "D": LENS.tolist()}})),
        ("camera.txt", "500 501 319 239 -0.28 0.07 0.0002 -0.0003\n"),
        ("camera.txt", "500, 501, 319, 239, -0.28, 0.07, 0.0002, -0.0003, 0\n"),
        ("cameras.txt", "# Camera list\n1 OPENCV 640 480 500 501 319.5 239.5 -0.28 0.07 0.0002 -0.0003\n"),
    ],
)
def test_one_camera_in_many_forms(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    calibration = read_calibration(tmp_path / name, [SIZE])
    camera = calibration.rig.cameras[0]
    assert (camera.width, camera.height, camera.focal_source) == (640, 480, "file")
    assert camera.focal_sigma == pytest.approx(5.0, rel=0.01)
    assert_is_opencvs(camera)
    assert not calibration.notes


@pytest.mark.parametrize("ending", ["yml", "xml", "json"])
def test_what_opencv_writes(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"calibration.{ending}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in [("image_width", 640), ("image_height", 480), ("camera_matrix", MATRIX)]:
        storage.write(name, value)
    storage.write("distortion_coefficients", LENS.reshape(-1, 1))
    storage.write("comment", 'a "quoted": text, with # signs')
    storage.release()
    assert_is_opencvs(read_calibration(path, [SIZE]).rig.cameras[0])


@pytest.mark.parametrize("ending", ["yml", "xml", "json"])
def test_a_pair_that_opencv_writes(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"stereo.{ending}"
    rotation = rigid3.exp_so3([0.01, -0.02, 0.005])
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in {"M1": MATRIX, "D1": LENS, "M2": MATRIX, "D2": LENS, "R": rotation}.items():
        storage.write(name, value)
    storage.write("T", np.array([-0.11, 0.001, 0.002]))
    storage.release()
    calibration = read_calibration(path, [SIZE, SIZE])
    assert_is_opencvs(calibration.rig.cameras[1])
    # x2 = R x1 + T
    np.testing.assert_allclose(
        rigid3.apply(calibration.rig.cam_from_rig[1], RAYS), RAYS @ rotation.T + [-0.11, 0.001, 0.002], atol=1e-9
    )
    assert not read_calibration(path, [SIZE]).rig.is_stereo


def test_kalibrs_camchain(tmp_path: Path) -> None:
    cam_from_imu, chain = (
        rigid3.from_matrix(rigid3.exp_so3(w), t)
        for w, t in [([0.1, 1.5, 0], [0.01, 0.02, 0.03]), ([0, 0.01, 0], [-0.1, 0, 0])]
    )

    def rows(pose: np.ndarray) -> str:
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rigid3.rotation_matrix(pose), pose[4:]
        return "".join(f"  - {row}\n" for row in matrix.tolist())

    one = (
        "  cam_overlaps: [1]\n  camera_model: pinhole\n  distortion_coeffs: [0.01, -0.002, 0.0003, 0.0001]\n"
        "  distortion_model: equidistant\n  intrinsics: [300.5, 301.5, 319.5, 239.5]\n  resolution: [640, 480]\n"
        "  rostopic: /cam/image_raw\n"
    )
    text = f"cam0:\n  T_cam_imu:\n{rows(cam_from_imu)}{one}cam1:\n  T_cn_cnm1:\n{rows(chain)}{one}"
    (tmp_path / "camchain.yaml").write_text(text)
    calibration = read_calibration(tmp_path / "camchain.yaml", [SIZE, SIZE])
    assert calibration.rig.cameras[1].model == CameraModel.OPENCV_FISHEYE
    np.testing.assert_allclose(calibration.rig.cam_from_rig[1], chain, atol=1e-9)
    assert calibration.body_from_cam is not None
    np.testing.assert_allclose(
        rigid3.apply(calibration.body_from_cam, RAYS), rigid3.apply(rigid3.inverse(cam_from_imu), RAYS)
    )
    expected = cv2.fisheye.projectPoints(
        RAYS[:, None], np.zeros(3), np.zeros(3), np.array([[300.5, 0, 319.5], [0, 301.5, 239.5], [0, 0, 1]]),
        np.array([0.01, -0.002, 0.0003, 0.0001]),
    )[0].reshape(-1, 2)  # fmt: skip
    np.testing.assert_allclose(project(calibration.rig.cameras[0], RAYS), expected + 0.5, atol=1e-6)


def test_another_size_of_the_same_shape_is_scaled(tmp_path: Path) -> None:
    (tmp_path / "sensor.yaml").write_text(EUROC)
    calibration = read_calibration(tmp_path / "sensor.yaml", [(320, 240)])
    expected = cv2.projectPoints(RAYS, np.zeros(3), np.zeros(3), MATRIX, LENS)[0].reshape(-1, 2) + 0.5
    np.testing.assert_allclose(project(calibration.rig.cameras[0], RAYS), expected / 2, atol=1e-9)
    assert "scaled" in calibration.notes[0]
    with pytest.raises(InputError, match="expected a calibration for images of 640x360 pixels, found one for 640x480"):
        read_calibration(tmp_path / "sensor.yaml", [(640, 360)])


@pytest.mark.parametrize(
    "lens",
    [
        [0.262383, -0.953104, -0.005358, 0.002628, 1.163314],
        [0.1, -0.2, 0.001, -0.001, 0.05, 0.11, -0.19, 0.04],
        [0.01, -0.02, 0.001, -0.001, 0.005, 0, 0, 0, 0.001, -0.002, 0.0, 0.001],
    ],
)
@pytest.mark.parametrize("scale", [1, 2])
def test_lenses_of_more_coefficients_are_resampled_exactly(lens: list[float], scale: int) -> None:
    calibrated = camera_from_opencv("test", SIZE, [500, 501, 319, 239], lens, False)
    camera, full = calibrated.camera, FullLens(SIZE, np.array([500.0, 501, 319, 239]), np.array(lens))
    assert camera.model == CameraModel.OPENCV
    assert len(calibrated.notes) == 1
    if calibrated.lens is None:  # near enough
        return
    params = camera.params.copy()
    params[:4] /= scale
    small = type(camera)(camera.model, SIZE[0] // scale, SIZE[1] // scale, params)
    sampling = sampling_map(small, calibrated.lens)
    assert sampling is not None
    # where our camera sees a ray, the map points to where the lens sees it
    for ray in RAYS:
        u, v = project(small, ray[None])[0] - 0.5
        if not (1 <= u < small.width - 2 and 1 <= v < small.height - 2):
            continue
        patch = cv2.remap(sampling, np.float32([[[u, v]]]), None, cv2.INTER_LINEAR)[0, 0]
        expected = (full.project(ray[None, :2])[0] + 0.5) / scale - 0.5
        np.testing.assert_allclose(patch, expected, atol=0.03)


def test_a_fit_that_is_good_needs_no_resampling() -> None:
    calibrated = camera_from_opencv("test", SIZE, [500, 501, 319, 239], [-0.28, 0.07, 2e-4, -3e-4, 1e-5], False)
    assert calibrated.lens is None
    assert_is_opencvs(calibrated.camera, np.array([-0.28, 0.07, 2e-4, -3e-4, 1e-5]), 0.05)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("c.json", "[1]", "expected a JSON object"),
        ("c.json", "{", "expected JSON"),
        ("c.json", '{"fx": NaN}', "finite"),
        ("c.json", '{"a": 1}', "expected a calibration .* found a"),
        ("c.json", '{"fx": 1e999, "fy": 1, "cx": 1, "cy": 1}', "finite"),
        ("c.json", '{"fx": "five", "fy": 1, "cx": 1, "cy": 1}', "finite"),
        ("c.json", '{"fx": -5, "fy": 1, "cx": 1, "cy": 1}', "positive focal"),
        ("c.json", '{"fx": 5, "fy": 5, "cx": 1, "cy": 1, "baseline": -3}', "baseline"),
        ("c.json", '{"fx": 5, "fy": 5, "cx": 1, "cy": 1, "width": 1.5, "height": 2}', "image size"),
        ("c.json", '{"K": [[5, 1, 2], [0, 5, 2], [0, 0, 1]]}', "no skew"),
        ("c.json", '{"K": [[5, 0, 2], [0, 5, 2], [0, 0, 1]], "distortion_model": "fov"}', "distortion model"),
        ("c.json", '{"intrinsics": [5, 5, 2, 2], "camera_model": "omni"}', "camera_model pinhole"),
        ("c.json", '{"K": [[5, 0, 2], [0, 5, 2], [0, 0, 1]], "D": [9, 9, -9, 9, -9]}', "cannot be inverted"),
        ("c.json", '{"K": [[5, 0, 2], [0, 5, 2], [0, 0, 1]], "T_BS": [1, 2]}', "T_BS: expected 4 x 4"),
        ("c.xml", '<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', "without document types"),
        ("c.xml", "<a><b></a>", "expected XML"),
        ("c.txt", "1 2 3", "expected fx fy cx cy"),
        ("c.txt", "1 PINHOLE 640 480 5", "PINHOLE has 4 parameters"),
        ("c.txt", "1 THIN_PRISM_FISHEYE 640 480 5", "THIN_PRISM_FISHEYE has 12 parameters, found 1"),
        ("c.txt", "1 FULL_OPENCV 640 480 5 5 320 240", "FULL_OPENCV has 12 parameters, found 4"),
        ("c.yaml", "just text", "'name: value'"),
        ("c.yaml", "", "'name: value'"),
    ],
)
def test_calibrations_that_are_none(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message):
        read_calibration(tmp_path / name, [SIZE])


EQUI = (0.02, 0.005, -0.002, 0.001)
RATIONAL = {"k1": 0.50, "k2": -0.10, "p1": 0.0007, "p2": -0.0002, "k3": 0.01, "k4": 0.80, "k5": -0.10, "k6": 0.02}
FXY = {"fx": 500, "fy": 501, "cx": 319, "cy": 239}


def opencv_matrix(rows: int, columns: int, values: object) -> str:
    return f"!!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: {values}\n"


def orb_slam(kind: str, number: str = "1", **coefficients: float) -> str:
    rows = "".join(f"Camera{number}.{name}: {value}\n" for name, value in (FXY | coefficients).items())
    return f'%YAML:1.0\n---\nFile.version: "1.0"\nCamera.type: "{kind}"\n{rows}Camera.width: 640\nCamera.height: 480\n'


def kalibr(model: str, distortion: str, coefficients: object = EQUI) -> str:
    return (
        f"cam0:\n  camera_model: {model}\n  distortion_model: {distortion}\n  distortion_coeffs: {list(coefficients)}\n"  # type: ignore[call-overload]
        "  intrinsics: [500, 501, 319, 239]\n  resolution: [640, 480]\n"
    )


K4 = dict(zip(("k1", "k2", "k3", "k4"), EQUI, strict=True))
FISHEYES = {
    "orb3.yaml": orb_slam("KannalaBrandt8", **K4),
    "opencv.yml": "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\nfisheye_model: 1\n"
    f"camera_matrix: {opencv_matrix(3, 3, MATRIX.ravel().tolist())}"
    f"distortion_coefficients: {opencv_matrix(4, 1, list(EQUI))}",
    "model.json": json.dumps(FXY | K4 | {"model": "fisheye"}),
    "flag.json": json.dumps(FXY | K4 | {"fisheye": True}),
    "lens.json": json.dumps({"K": MATRIX.tolist(), "dist": EQUI, "lens_type": "OPENCV_FISHEYE"}),
    "nested.json": json.dumps({"K": MATRIX.tolist(), "distortion": {"type": "kannala_brandt4", **K4}}),
    "pair.json": json.dumps({"model": "fisheye", "cam0": {"K": MATRIX.tolist(), "D": EQUI}}),
    "rows.json": json.dumps({"distortion_model": "equidistant", "K1": MATRIX.tolist(), "D1": EQUI}),
    "ros.yaml": ROS.replace("plumb_bob", "equidistant").replace("[-0.28, 0.07, 0.0002, -0.0003, 0]", str(list(EQUI))),
    "ros2.yaml": ROS.replace("plumb_bob", "fisheye").replace("[-0.28, 0.07, 0.0002, -0.0003, 0]", str(list(EQUI))),
    "camchain.yaml": kalibr("pinhole", "equidistant"),
    "vins.yaml": "%YAML:1.0\n---\nmodel_type: KANNALA_BRANDT\ncamera_name: cam0\nimage_width: 640\nimage_height: 480\n"
    "projection_parameters:\n" + "".join(f"   k{n + 2}: {value}\n" for n, value in enumerate(EQUI))
    + "   mu: 500\n   mv: 501\n   u0: 319\n   v0: 239\n",
    "cameras.txt": "1 OPENCV_FISHEYE 640 480 500 501 319.5 239.5 " + " ".join(map(str, EQUI)),
}  # fmt: skip


@pytest.mark.parametrize("name", FISHEYES)
def test_fisheye_lenses_by_all_their_names(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(FISHEYES[name])
    camera = read_calibration(tmp_path / name, [SIZE]).rig.cameras[0]
    expected = cv2.fisheye.projectPoints(RAYS[:, None], np.zeros(3), np.zeros(3), MATRIX, np.array(EQUI))[0]
    np.testing.assert_allclose(project(camera, RAYS), expected.reshape(-1, 2) + 0.5, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "text", "lens"),
    [
        ("scalars.json", json.dumps(FXY | RATIONAL), list(RATIONAL.values())),
        ("list.json", json.dumps(FXY | {"dist": list(RATIONAL.values())}), list(RATIONAL.values())),
        ("named.json", json.dumps(FXY | RATIONAL | {"model": "rational_polynomial"}), list(RATIONAL.values())),
        ("inside.json", json.dumps({"K": MATRIX.tolist(), "distortion": RATIONAL}), list(RATIONAL.values())),
        (
            "prism.json", json.dumps(FXY | {"k1": 0.01, "s1": 0.001, "s4": -0.002, "tau_x": 0.01, "tauy": -0.02}),
            [0.01, *[0.0] * 7, 0.001, 0, 0, -0.002, 0.01, -0.02],
        ),
        ("orb.yaml", orb_slam("PinHole", k1=-0.28, k2=0.07, p1=0.0002, p2=-0.0003, k3=0.1), [*LENS, 0.1]),
        ("orb1.yaml", orb_slam("Rectified"), [0.0] * 5),
        ("kalibr.yaml", kalibr("pinhole", "none", []), [0.0] * 5),
        ("opencv.json", json.dumps(FXY | {"fisheye_model": 0, "k1": 0.1}), [0.1, 0, 0, 0]),
        (
            "cameras.txt", "1 FULL_OPENCV 640 480 500 501 319.5 239.5 " + " ".join(map(str, RATIONAL.values())),
            list(RATIONAL.values()),
        ),
    ],
)  # fmt: skip
def test_all_coefficients_of_perspective_lenses_count(tmp_path: Path, name: str, text: str, lens: list[float]) -> None:
    (tmp_path / name).write_text(text)
    calibration = read_calibration(tmp_path / name, [SIZE])
    camera, full = calibration.rig.cameras[0], calibration.lenses[0]
    if full is not None:  # frames are resampled from the lens itself
        expected = cv2.projectPoints(RAYS, np.zeros(3), np.zeros(3), MATRIX, np.array(lens))[0].reshape(-1, 2)
        np.testing.assert_allclose(full.project(RAYS[:, :2]), expected, atol=1e-9)
    else:
        assert_is_opencvs(camera, np.array(lens), 1e-9 if len(lens) < 5 or not any(lens[4:]) else 0.3)


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("FISHEYE", [500, 501, 319.5, 239.5]),
        ("SIMPLE_FISHEYE", [500, 319.5, 239.5]),
        ("SIMPLE_RADIAL_FISHEYE", [500, 319.5, 239.5, 0.02]),
        ("RADIAL_FISHEYE", [500, 319.5, 239.5, 0.02, -0.004]),
        ("SIMPLE_RADIAL", [500, 319.5, 239.5, -0.1]),
    ],
)
def test_colmaps_models_against_pycolmap(tmp_path: Path, model: str, params: list[float]) -> None:
    import pycolmap

    (tmp_path / "cameras.txt").write_text(f"# a comment\n1 {model} 640 480 {' '.join(map(str, params))}\n")
    (tmp_path / "c.json").write_text(json.dumps({"model": model, "width": 640, "height": 480, "params": params}))
    theirs = pycolmap.Camera(model=model, width=640, height=480, params=params)
    for name in ("cameras.txt", "c.json"):
        camera = read_calibration(tmp_path / name, [SIZE]).rig.cameras[0]
        np.testing.assert_allclose(project(camera, RAYS), theirs.img_from_cam(RAYS), atol=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (kalibr("omni", "radtan"), "camera_model pinhole.* found 'omni'"),
        (kalibr("ds", "none", []), "found 'ds'"),
        (kalibr("eucm", "none", []), "found 'eucm'"),
        (kalibr("pinhole", "fov", [0.9]), "distortion model .* found 'fov'"),
        (kalibr("pinhole", "none"), "no coefficients of a lens without distortion"),
        (orb_slam("KannalaBrandt8", **K4).replace("KannalaBrandt8", "Scaramuzza"), "type pinhole.* found 'Scaramuzza'"),
        (orb_slam("KannalaBrandt8", p1=0.1), "found p1 as well"),
        (orb_slam("PinHole") + "LEFT.K: [1, 2]\n", "rectifies with LEFT.K"),
        ("model: fisheye\ndistortion_model: plumb_bob\nK: [500, 0, 319, 0, 501, 239, 0, 0, 1]\n", "one type of lens"),
        ("fisheye_model: 2\nK: [500, 0, 319, 0, 501, 239, 0, 0, 1]\n", "fisheye_model of 0 or 1"),
        ("".join(f"{name}: {value}\n" for name, value in (FXY | K4).items()), "k4 without k5 and k6"),
        ("model_type: MEI\nmirror_parameters:\n  xi: 1.9\nprojection_parameters:\n  gamma1: 800\n", "catadioptric"),
    ],
)
def test_types_that_are_not_known_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_calibration(tmp_path / "c.yaml", [SIZE])
    assert caught.value.advice


def test_a_pair_of_orb_slam(tmp_path: Path) -> None:
    """T_c1_c2 takes points of the second camera to the first."""
    pose = "".join(f"{v}, " for v in [1, 0, 0, 0.1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]).rstrip(", ")
    text = orb_slam("KannalaBrandt8", **K4) + "".join(f"Camera2.{k}: {v}\n" for k, v in (FXY | K4).items())
    (tmp_path / "a.yaml").write_text(f"{text}Camera.fps: 20\nStereo.T_c1_c2: {opencv_matrix(4, 4, f'[{pose}]')}")
    calibration = read_calibration(tmp_path / "a.yaml", [SIZE, SIZE])
    np.testing.assert_allclose(calibration.rig.cam_from_rig[1], [0, 0, 0, 1, -0.1, 0, 0])
    assert [camera.model for camera in calibration.rig.cameras] == [CameraModel.OPENCV_FISHEYE] * 2
    assert calibration.frames_per_second == 20
    (tmp_path / "b.yaml").write_text(orb_slam("Rectified") + "Stereo.b: 0.12\n")
    assert read_calibration(tmp_path / "b.yaml", [SIZE, SIZE]).rig.cam_from_rig[1, 4] == -0.12
    (tmp_path / "c.yaml").write_text(orb_slam("PinHole", "").replace("1.0", "1") + "Camera.bf: 60\n")
    assert read_calibration(tmp_path / "c.yaml", [SIZE, SIZE]).rig.cam_from_rig[1, 4] == -0.12


def test_the_samples_of_opencv(data_root: Path) -> None:
    folder = data_root / "opencv-doc-samples" / "calib"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    calibration = read_calibration(folder / "left_intrinsics.yml", [SIZE])
    assert calibration.rig.cameras[0].focal == pytest.approx(535.9, rel=0.01)
    assert calibration.notes  # five coefficients
    assert read_calibration(folder / "intrinsics.yml", [SIZE, SIZE]).rig.is_stereo is False


# --------------------------------------------------------------------------------------------------------------- YAML

scalars = st.one_of(
    st.integers(-(10**9), 10**9),
    st.floats(allow_nan=False, allow_infinity=False),
    st.booleans(),
    st.none(),
    st.text(alphabet="abcdefgh xyz/_.", min_size=1, max_size=12).map(str.strip).filter(
        lambda text: text and text.lower() not in ("true", "false", "null", "e") and text[0] != "."
    ),
)  # fmt: skip
names = st.text(alphabet="abcXYZ_0", min_size=1, max_size=8)
values = st.recursive(
    scalars,
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(names, inner, max_size=4)),
    max_leaves=12,
)


def as_yaml(value: object, indent: int) -> str:
    """Block style for maps, flow style for lists, as calibration tools write."""
    pad = " " * indent
    if isinstance(value, dict) and value:
        return "\n" + "".join(f"{pad}{name}:{as_yaml(item, indent + 2)}" for name, item in value.items())
    return " " + as_flow(value) + "  # a comment\n"


def as_flow(value: object) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{name}: {as_flow(item)}" for name, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(as_flow, value)) + "]"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "False"}[value]
    return str(value) if isinstance(value, str) else repr(value)


@given(st.dictionaries(names, values, min_size=1, max_size=5))
def test_yaml_round_trips(document: dict[str, object]) -> None:
    assert parse_flat_yaml(f"%YAML:1.0\n---{as_yaml(document, 0)}", "test") == document


@given(st.text(alphabet="ab1.-:[]{},#\"'!&* \n\t", max_size=60))
def test_yaml_reads_or_refuses(text: str) -> None:
    with contextlib.suppress(InputError):
        assert isinstance(parse_flat_yaml(text, "test"), dict)


@pytest.mark.parametrize(
    "text",
    [
        "a: " + "[" * 1000 + "]" * 1000,
        "- " * 1000 + "a",
        "a: {" * 1000,
        "\n".join(" " * i + f"a{i}:" for i in range(1000)),
    ],
)
def test_yaml_too_deep_is_refused(text: str) -> None:
    with pytest.raises(InputError):
        parse_flat_yaml(text, "test")


@pytest.mark.parametrize(
    "text",
    [
        "a: &x 1\n",
        "a: *x\n",
        "a: |\n  text\n",
        "a: 1\na: 2\n",
        "a: [1, 2\n",
        "a: [1 2}\n",
        "a: 1\n   b: 2\n",
        "a: [1] 2\n",
    ],
)
def test_yaml_beyond_the_part_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="test"):
        parse_flat_yaml(text, "test")


def test_the_covariance_in_a_calibration_is_the_prior(tmp_path: Path) -> None:
    """Scaled with the photographs; without a focal length that varied there is none."""
    root = np.array([[0.2, 0.0, 0.0, 0.0], [0.05, 0.3, 0.0, 0.0], [0.0, 0.1, 0.3, 0.0], [4e-5, 0.0, 0.0, 1e-4]])
    fields = {"model": "SIMPLE_RADIAL", "width": 640, "height": 480, "params": [500.0, 320.0, 240.0, -0.1]}
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(fields | {"covariance": (root @ root.T).tolist()}))
    (found,) = read_given_cameras(str(path)).of_photographs("", [Photograph("a.jpg", (1280, 960))])
    assert found.camera.focal_sigma == pytest.approx(0.4)
    assert found.camera.prior_covariance is not None
    by = np.array([2.0, 2.0, 2.0, 1.0])
    np.testing.assert_allclose(found.camera.prior_covariance, root @ root.T * np.outer(by, by))
    assert "held as its covariance says, the focal length to 0.2 px" in found.reason
    path.write_text(json.dumps(fields | {"covariance": np.zeros((4, 4)).tolist()}))
    (found,) = read_given_cameras(str(path)).of_photographs("", [Photograph("a.jpg", (640, 480))])
    assert found.camera.focal_sigma == pytest.approx(5.0)
    for wrong in (np.eye(3), -np.eye(4)):
        path.write_text(json.dumps(fields | {"covariance": wrong.tolist()}))
        with pytest.raises(InputError, match="expected one of 4 parameters"):
            read_given_cameras(str(path)).of_photographs("", [Photograph("a.jpg", (640, 480))])
