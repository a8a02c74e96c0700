"""``--camera`` for photographs: calibrations in everybody's forms, several cameras, and what does not fit."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from sfmapp.camera.camera import Camera, CameraModel, pixels_to_normalized, project
from sfmapp.camera_files.reading import read_calibration
from sfmapp.cli.main import main
from sfmapp.errors import InputError, UsageError
from sfmapp.events import Event, Events
from sfmapp.formats.colmap import read_model
from sfmapp.images.folder import load_images
from sfmapp.images.image_set import ImageOptions, ImageSet
from sfmapp.pipelines.demo import compare_with_ground_truth
from sfmapp.scene.turned_camera import turned_camera

W, H = 400, 300
# a strong barrel, off-centre; its picture shows no more than those of the sample do
BARREL = Camera(CameraModel.OPENCV, W, H, np.array([440.0, 444.0, 196.5, 152.5, -0.28, 0.06, 0.003, -0.002]))
FISHEYE = Camera(CameraModel.OPENCV_FISHEYE, W, H, np.array([450.0, 452.0, 203.5, 148.5, -0.05, 0.01, -0.002, 0.001]))
FX, FY, CX, CY, *LENS = BARREL.params.tolist()
MATRIX = np.array([[FX, 0.0, CX - 0.5], [0.0, FY, CY - 0.5], [0.0, 0.0, 1.0]])  # OpenCV's pixel centres
RAYS = np.stack([*np.meshgrid(np.linspace(-0.4, 0.4, 7), np.linspace(-0.3, 0.3, 5)), np.ones((5, 7))], -1).reshape(
    -1, 3
)


def write_photos(folder: Path, *names: str, size: tuple[int, int] = (W, H), exif: Image.Exif | None = None) -> Path:
    for number, name in enumerate(names or ("a.png", "b.png", "c.png")):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        pixels = np.random.default_rng([number, *size]).integers(0, 256, size[::-1], dtype=np.uint8)
        Image.fromarray(pixels).save(path, **({} if exif is None else {"exif": exif}))
    return folder


def exif_of(orientation: int = 1, focal_35mm: float | None = None) -> Image.Exif:
    exif = Image.Exif()
    exif.update({271: "Canon", 272: "Canon EOS 60D", 274: orientation})
    if focal_35mm is not None:
        exif.get_ifd(34665).update({41989: focal_35mm})
    return exif


def load(source: Path, camera: Path | str, **options: Any) -> tuple[ImageSet, dict[str, Any], list[Event]]:
    log: list[Event] = []
    image_set, report = load_images(source, ImageOptions(camera=str(camera), **options), Events(log.append))
    return image_set, report, log


def camera_by_name(image_set: ImageSet) -> dict[str, Camera]:
    return {image.name: image_set.cameras[image.camera_idx] for image in image_set.images}


def warnings_of(log: list[Event]) -> list[str]:
    return [event.message for event in log if event.kind == "warned"]


# ------------------------------------------------------------------------------------------------ whatever its form


def opencv_storage(ending: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        path = folder / f"calibration.{ending}"
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        for name, value in [("image_width", W), ("image_height", H), ("camera_matrix", MATRIX)]:
            storage.write(name, value)
        storage.write("distortion_coefficients", np.array(LENS).reshape(-1, 1))
        storage.release()
        return path

    return write


def kalibr(folder: Path) -> Path:
    path = folder / "camchain.yaml"
    path.write_text(f"cam0:\n{kalibr_section(BARREL)}")
    return path


def kalibr_section(camera: Camera) -> str:
    fx, fy, cx, cy, *lens = camera.params.tolist()
    model = "equidistant" if camera.model == CameraModel.OPENCV_FISHEYE else "radtan"
    return (
        f"  camera_model: pinhole\n  distortion_coeffs: {lens}\n  distortion_model: {model}\n"
        f"  intrinsics: [{fx}, {fy}, {cx - 0.5}, {cy - 0.5}]\n  resolution: [{camera.width}, {camera.height}]\n"
        "  rostopic: /camera/image_raw\n"
    )


def ros(folder: Path) -> Path:
    path = folder / "camera_info.yaml"
    path.write_text(
        f"image_width: {W}\nimage_height: {H}\ncamera_name: front\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
        f"  data: {MATRIX.ravel().tolist()}\ndistortion_model: plumb_bob\ndistortion_coefficients:\n  rows: 1\n"
        f"  cols: 5\n  data: {[*LENS, 0.0]}\n"
    )
    return path


def orb_slam(folder: Path) -> Path:
    path = folder / "settings.yaml"
    values = {
        "fx": FX,
        "fy": FY,
        "cx": CX - 0.5,
        "cy": CY - 0.5,
        **dict(zip(("k1", "k2", "p1", "p2"), LENS, strict=True)),
    }
    lines = [f"Camera1.{name}: {value}" for name, value in values.items()]
    path.write_text(
        "\n".join(["%YAML:1.0", 'Camera.type: "PinHole"', *lines, f"Camera.width: {W}", f"Camera.height: {H}"])
    )
    return path


def own_json(folder: Path) -> Path:
    path = folder / "calib.json"
    path.write_text(json.dumps({"K": MATRIX.tolist(), "dist": LENS, "width": W, "height": H}))
    return path


def cameras_json(folder: Path) -> Path:
    """With the places of views, as ``validate`` and ``evaluate`` take it."""
    path = folder / "cameras.json"
    view = {"K": MATRIX.tolist(), "dist": LENS, "width": W, "height": H, "R_w2c": np.eye(3).tolist()}
    path.write_text(json.dumps({"cameras": [view | {"file": f"{k}.jpg", "t_w2c": [k, 0, 0]} for k in range(3)]}))
    return path


def transforms_json(folder: Path) -> Path:
    path = folder / "transforms.json"
    lens = dict(zip(("k1", "k2", "p1", "p2"), LENS, strict=True))
    shared = {"camera_model": "OPENCV", "w": W, "h": H, "fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY, **lens}
    frames = [{"file_path": f"images/{k}.jpg", "transform_matrix": np.eye(4).tolist()} for k in range(3)]
    path.write_text(json.dumps(shared | {"frames": frames}))
    return path


def pycolmap_model(cameras: list[Camera], images: dict[str, int]) -> Any:
    import pycolmap

    model = pycolmap.Reconstruction()
    for camera_id, camera in enumerate(cameras, 1):
        params = {"width": camera.width, "height": camera.height, "params": camera.params, "camera_id": camera_id}
        model.add_camera_with_trivial_rig(pycolmap.Camera(model=camera.model.name, **params))
    for image_id, (name, camera_id) in enumerate(images.items(), 1):
        image = pycolmap.Image(name=name, camera_id=camera_id, image_id=image_id)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    return model


def colmap(is_text: bool, name: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        (folder / "sparse" / "0").mkdir(parents=True)
        model = pycolmap_model([BARREL], {"somewhere/else.jpg": 1})
        (model.write_text if is_text else model.write_binary)(str(folder / "sparse" / "0"))
        return folder / name

    return write


def euroc(folder: Path) -> Path:
    (folder / "mav0" / "cam0").mkdir(parents=True)
    (folder / "mav0" / "cam0" / "sensor.yaml").write_text(
        f"sensor_type: camera\nresolution: [{W}, {H}]\ncamera_model: pinhole\n"
        f"intrinsics: [{FX}, {FY}, {CX - 0.5}, {CY - 0.5}]\ndistortion_model: radial-tangential\n"
        f"distortion_coefficients: {LENS}\n"
    )
    return folder / "mav0"


FORMS: dict[str, Callable[[Path], Path]] = {
    "opencv-yml": opencv_storage("yml"), "opencv-xml": opencv_storage("xml"), "opencv-json": opencv_storage("json"),
    "kalibr": kalibr, "ros": ros, "orb-slam": orb_slam, "calib.json": own_json, "cameras.json": cameras_json,
    "transforms.json": transforms_json, "euroc": euroc,
    "cameras.txt": colmap(True, "sparse/0/cameras.txt"), "cameras.bin": colmap(False, "sparse/0/cameras.bin"),
    "model": colmap(False, "sparse/0"), "folder-of-a-model": colmap(True, "."),
}  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
def test_photographs_have_the_camera_of_the_calibration(tmp_path: Path, form: str) -> None:
    (tmp_path / "calibration").mkdir()
    path = FORMS[form](tmp_path / "calibration")
    image_set, report, log = load(write_photos(tmp_path / "photos"), path)
    (camera,) = image_set.cameras
    assert (camera.model, camera.width, camera.height) == (CameraModel.OPENCV, W, H)
    np.testing.assert_allclose(camera.params, BARREL.params, rtol=1e-12)
    expected = cv2.projectPoints(RAYS, np.zeros(3), np.zeros(3), MATRIX, np.array(LENS))[0].reshape(-1, 2) + 0.5
    np.testing.assert_allclose(project(camera, RAYS), expected, atol=1e-9)
    assert (camera.focal_source, camera.is_fixed) == ("user", False)
    assert camera.focal_sigma == pytest.approx(0.01 * camera.focal)
    assert path.name in report["cameras"][0]["focal_reason"] or form == "folder-of-a-model"
    assert not warnings_of(log)
    # the same file is the camera of a sequence
    np.testing.assert_allclose(read_calibration(path, [(W, H)]).rig.cameras[0].params, BARREL.params, rtol=1e-12)


def test_numbers_are_a_camera_too(tmp_path: Path) -> None:
    text = ",".join(["OPENCV", *map(repr, BARREL.params.tolist())])
    (camera,) = load(write_photos(tmp_path), text)[0].cameras
    np.testing.assert_array_equal(camera.params, BARREL.params)
    (known,) = load_images(
        tmp_path, ImageOptions(camera_model=CameraModel.OPENCV, camera_params=tuple(BARREL.params)), Events()
    )[0].cameras
    assert (camera.focal_sigma, camera.focal_source) == (known.focal_sigma, known.focal_source)


def test_fixed_intrinsics_and_sharing_are_obeyed(tmp_path: Path) -> None:
    photos = write_photos(tmp_path / "photos", "x/a.png", "x/b.png", "y/c.png")
    calibration = own_json(tmp_path)
    sharing = ("auto", "per_folder", "per_image")
    found = [len(load(photos, calibration, camera_sharing=how)[0].cameras) for how in sharing]
    assert found == [1, 2, 3]
    assert load(photos, own_json(tmp_path), fix_intrinsics=True)[0].cameras[0].is_fixed


# ---------------------------------------------------------------------------------------------------- several cameras

PAIR = f"cam0:\n{kalibr_section(BARREL)}cam1:\n{kalibr_section(FISHEYE)}"


@pytest.mark.parametrize(
    ("first", "second"),
    [("cam0", "cam1"), ("left", "right"), ("Left", "Right"), ("image_00", "image_01"), ("cam0/data", "cam1/data")],
)
def test_folders_tell_cameras_apart(tmp_path: Path, first: str, second: str) -> None:
    (tmp_path / "camchain.yaml").write_text(PAIR)
    photos = write_photos(tmp_path / "photos", f"{first}/1.png", f"{first}/2.png", f"{second}/1.png")
    image_set, report, _ = load(photos, tmp_path / "camchain.yaml")
    found = {name: camera.model for name, camera in camera_by_name(image_set).items()}
    assert found == {
        f"{first}/1.png": CameraModel.OPENCV, f"{first}/2.png": CameraModel.OPENCV,
        f"{second}/1.png": CameraModel.OPENCV_FISHEYE,
    }  # fmt: skip
    assert [entry["num_images"] for entry in report["cameras"]] == [2, 1]
    assert report["cameras"][1]["focal_reason"] == "camchain.yaml: cam1"
    # the folder itself has the name
    (camera,) = load(photos / second, tmp_path / "camchain.yaml")[0].cameras
    assert camera.model == CameraModel.OPENCV_FISHEYE


def test_pairs_of_opencv_and_cameras_of_any_name(tmp_path: Path) -> None:
    storage = cv2.FileStorage(str(tmp_path / "stereo.yml"), cv2.FILE_STORAGE_WRITE)
    other = MATRIX * [[1.1], [1.1], [1.0]]
    for name, value in {"M1": MATRIX, "D1": np.array(LENS), "M2": other, "D2": np.zeros(4)}.items():
        storage.write(name, value)
    storage.release()
    photos = write_photos(tmp_path / "photos", "left/1.png", "right/1.png")
    found = camera_by_name(load(photos, tmp_path / "stereo.yml")[0])
    assert found["left/1.png"].params[0] == pytest.approx(FX)
    assert found["right/1.png"].params[0] == pytest.approx(1.1 * FX)
    sections = {name: {"K": matrix.tolist()} for name, matrix in (("front", MATRIX), ("rear", other))}
    (tmp_path / "rig.json").write_text(json.dumps(sections))
    photos = write_photos(tmp_path / "others", "run1/front/1.png", "run1/rear/1.png")
    found = camera_by_name(load(photos, tmp_path / "rig.json")[0])
    assert found["run1/rear/1.png"].params[0] == pytest.approx(1.1 * FX)


@pytest.mark.parametrize("is_text", [True, False])
def test_a_model_tells_by_the_names_of_its_images(tmp_path: Path, is_text: bool) -> None:
    names = {"shots/a.jpg": 1, "shots/b.jpg": 2, "shots/c.jpg": 1}
    (tmp_path / "model").mkdir()
    model = pycolmap_model([BARREL, FISHEYE], names)
    (model.write_text if is_text else model.write_binary)(str(tmp_path / "model"))
    photos = write_photos(tmp_path / "photos", *names)
    for source, prefix in ((photos, "shots/"), (photos / "shots", "")):
        found = {name: camera.model for name, camera in camera_by_name(load(source, tmp_path / "model")[0]).items()}
        assert found == {
            f"{prefix}a.jpg": CameraModel.OPENCV, f"{prefix}b.jpg": CameraModel.OPENCV_FISHEYE,
            f"{prefix}c.jpg": CameraModel.OPENCV,
        }  # fmt: skip
    with pytest.raises(InputError, match=r"found 2 different ones"):
        read_calibration(tmp_path / "model", [(W, H)])


def test_a_model_tells_by_the_folders_of_its_images_and_by_their_sizes(tmp_path: Path) -> None:
    small = Camera(CameraModel.PINHOLE, W // 2, H // 2, np.array([200.0, 200.0, 100.0, 75.0]))
    names = {"left/1.jpg": 1, "left/2.jpg": 1, "right/1.jpg": 2, "plain.jpg": 2}
    (tmp_path / "model").mkdir()
    pycolmap_model([BARREL, FISHEYE, small], names | {"phone.jpg": 3}).write_text(str(tmp_path / "model"))
    other = write_photos(tmp_path / "other", "left/77.png", "right/78.png")
    found = camera_by_name(load(other, tmp_path / "model")[0])
    assert found["left/77.png"].model == CameraModel.OPENCV
    assert found["right/78.png"].model == CameraModel.OPENCV_FISHEYE
    # a picture that did not make it into the model, of a size that only one camera has
    phone = write_photos(tmp_path / "more", "phone.jpg", "phone2.jpg", size=(W // 2, H // 2))
    found = camera_by_name(load(phone, tmp_path / "model")[0])
    assert [camera.model for camera in found.values()] == [CameraModel.PINHOLE] * 2


def test_views_of_cameras_json_with_different_cameras(tmp_path: Path) -> None:
    views = [
        {"file": f"images/{name}.jpg", "K": (MATRIX * [[scale], [scale], [1.0]]).tolist(), "dist": LENS}
        for name, scale in (("a", 1.0), ("b", 1.05), ("c", 1.0))
    ]
    (tmp_path / "cameras.json").write_text(json.dumps({"cameras": views}))
    image_set, _, _ = load(write_photos(tmp_path / "photos"), tmp_path / "cameras.json")
    assert [camera.params[0] / FX for camera in camera_by_name(image_set).values()] == pytest.approx([1, 1.05, 1])
    assert len(image_set.cameras) == 2


def test_what_does_not_tell_cameras_apart_is_refused_with_the_names_found(tmp_path: Path) -> None:
    (tmp_path / "camchain.yaml").write_text(PAIR)
    message = r"camchain.yaml.*which camera took a.png, found 2 cameras \(cam0, cam1\)"
    with pytest.raises(InputError, match=message) as caught:
        load(write_photos(tmp_path / "photos"), tmp_path / "camchain.yaml")
    assert "cam0, left" in str(caught.value.advice)
    (tmp_path / "model").mkdir()
    pycolmap_model([BARREL, FISHEYE], {"x.jpg": 1, "y.jpg": 2}).write_text(str(tmp_path / "model"))
    with pytest.raises(InputError, match=r"took a.png.* for images such as x.jpg, y.jpg"):
        load(tmp_path / "photos", tmp_path / "model")


# ------------------------------------------------------------------------------------------------ sizes and turning


@pytest.mark.parametrize("scale", [2, 0.5])
def test_another_size_of_the_same_shape_is_scaled_and_said(tmp_path: Path, scale: float) -> None:
    photos = write_photos(tmp_path / "photos", size=(int(W * scale), int(H * scale)))
    image_set, report, log = load(photos, own_json(tmp_path))
    np.testing.assert_allclose(project(image_set.cameras[0], RAYS), project(BARREL, RAYS) * scale, rtol=1e-12)
    assert f"calibrated at {W}x{H}, scaled" in report["cameras"][0]["focal_reason"]
    assert any(f"calibrated at {W}x{H}, scaled" in event.message for event in log)


def test_photographs_of_two_sizes_need_a_calibration_that_states_its_own(tmp_path: Path) -> None:
    write_photos(tmp_path / "photos", "a.png", "b.png")
    write_photos(tmp_path / "photos", "c.png", size=(W // 2, H // 2))
    image_set, _, _ = load(tmp_path / "photos", own_json(tmp_path))
    assert [camera.params[0] for camera in image_set.cameras] == pytest.approx([FX, FX / 2])
    (tmp_path / "sizeless.json").write_text(json.dumps({"K": MATRIX.tolist(), "dist": LENS}))
    for given in (tmp_path / "sizeless.json", ",".join(["OPENCV", *map(str, BARREL.params)])):
        with pytest.raises(InputError, match="photographs of several: 200x150, 400x300"):
            load(tmp_path / "photos", given)


def test_another_shape_is_refused_with_file_and_photograph(tmp_path: Path) -> None:
    photos = write_photos(tmp_path / "photos", size=(W, H - 50))
    with pytest.raises(InputError, match=r"calib.json.*shape of a.png, 400x250 pixels, found one for 400x300"):
        load(photos, own_json(tmp_path))
    turned = write_photos(tmp_path / "turned", size=(H, W))
    with pytest.raises(InputError, match="300x400 pixels, found one for 400x300") as caught:
        load(turned, own_json(tmp_path))
    assert "turned" in str(caught.value.advice)


@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
def test_a_calibration_of_upright_pictures_is_turned_back(tmp_path: Path, orientation: int) -> None:
    photos = write_photos(tmp_path / "photos", "a.jpg", "b.jpg", exif=exif_of(orientation))
    write_photos(tmp_path / "photos", "level.jpg", exif=exif_of(1))
    upright = turned_camera(BARREL, orientation)
    fx, fy, cx, cy, *lens = upright.params.tolist()
    fields = {"fx": fx, "fy": fy, "cx": cx - 0.5, "cy": cy - 0.5, "dist": lens}
    (tmp_path / "calib.json").write_text(json.dumps(fields | {"width": H, "height": W}))
    image_set, report, _ = load(photos, tmp_path / "calib.json")
    np.testing.assert_allclose(image_set.cameras[0].params, BARREL.params, rtol=1e-12)
    assert "turned back to the pixels of the files" in report["cameras"][0]["focal_reason"]
    # without a size the principal point tells, and the message what to give
    (tmp_path / "calib.json").write_text(json.dumps(fields))
    with pytest.raises(InputError, match="turned upright as EXIF says") as caught:
        load(photos, tmp_path / "calib.json")
    given = str(caught.value.advice).removeprefix("give --camera ")
    np.testing.assert_allclose(load(photos, given)[0].cameras[0].params, BARREL.params, rtol=1e-8)


def test_pictures_turned_both_ways_do_not_tell_how_a_calibration_was_turned(tmp_path: Path) -> None:
    photos = write_photos(tmp_path / "photos", "a.jpg", exif=exif_of(6))
    write_photos(tmp_path / "photos", "b.jpg", exif=exif_of(8))
    fields = {"fx": FY, "fy": FX, "cx": 150.0, "cy": 200.0, "width": H, "height": W}
    (tmp_path / "calib.json").write_text(json.dumps(fields))
    with pytest.raises(InputError, match="found one for 300x400"):
        load(photos, tmp_path / "calib.json")


@pytest.mark.parametrize(
    ("lens", "model"),
    [
        ([-0.25, 0.09, 0.001, -0.002, -0.016], CameraModel.FULL_OPENCV),
        ([0.5, -0.4, 0.0003, -0.0002, 0.1, 0.8, -0.3, 0.05], CameraModel.FULL_OPENCV),
        ([-0.25, 0.06, 0, 0, 0, 0, 0, 0, 0.002, -0.001, 0.003, 0.001], CameraModel.OPENCV_THIN_PRISM),
    ],
)
@pytest.mark.parametrize("scale", [1, 2])
def test_lenses_of_more_coefficients_are_held_exactly(
    tmp_path: Path, lens: list[float], model: CameraModel, scale: int
) -> None:
    matrix = np.array([[230.0, 0, 199.0], [0, 231.0, 149.0], [0, 0, 1]])
    path = tmp_path / "calib.json"
    path.write_text(json.dumps({"K": matrix.tolist(), "dist": lens, "width": W, "height": H}))
    image_set, _, _ = load(write_photos(tmp_path / "photos", size=(scale * W, scale * H)), path)
    expected = cv2.projectPoints(RAYS, np.zeros(3), np.zeros(3), matrix, np.array(lens))[0].reshape(-1, 2) + 0.5
    np.testing.assert_allclose(project(image_set.cameras[0], RAYS), scale * expected, atol=1e-9)
    assert image_set.cameras[0].model == model


def test_panoramas_have_cameras_too(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("1 EQUIRECTANGULAR 2000 1000 2000 1000\n")
    photos = write_photos(tmp_path / "photos", "a.jpg", size=(400, 200), exif=exif_of(focal_35mm=8))
    image_set, _, log = load(photos, tmp_path / "cameras.txt")
    assert image_set.cameras[0].params.tolist() == [400.0, 200.0]
    assert not warnings_of(log)


def test_a_tilted_sensor_is_refused(tmp_path: Path) -> None:
    lens = [-0.25, 0.06, *[0.0] * 10, 0.05, -0.02]
    fields = {"fx": 230.0, "fy": 231.0, "cx": 199.0, "cy": 149.0, "dist": lens, "width": W, "height": H}
    (tmp_path / "calib.json").write_text(json.dumps(fields))
    with pytest.raises(InputError, match=r"calib.json.*tilted") as caught:
        load(write_photos(tmp_path / "photos"), tmp_path / "calib.json")
    assert "CALIB_TILTED_MODEL" in str(caught.value.advice)


# ----------------------------------------------------------------------------------------------------- contradictions


@pytest.mark.parametrize(("focal_35mm", "is_told"), [(40, False), (44, False), (24, True), (70, True)])
def test_exif_that_clearly_says_another_focal_length_is_told(tmp_path: Path, focal_35mm: float, is_told: bool) -> None:
    # 442 px of a diagonal of 500 are 38 mm of one of 43.3
    photos = write_photos(tmp_path / "photos", "a.jpg", "b.jpg", exif=exif_of(focal_35mm=focal_35mm))
    image_set, _, log = load(photos, own_json(tmp_path))
    assert image_set.cameras[0].focal == pytest.approx(442.0)
    told = [message for message in warnings_of(log) if "focal length of 442 px, EXIF says" in message]
    assert len(told) == is_told
    assert all("a.jpg, b.jpg" in message for message in told)


def test_numbers_that_no_camera_has_are_told(tmp_path: Path) -> None:
    numbers = {"fx": 1.1, "fy": 1.1, "cx": 0.5, "cy": 0.5, "width": W, "height": H}
    (tmp_path / "calib.json").write_text(json.dumps(numbers))
    (told,) = warnings_of(load(write_photos(tmp_path / "photos"), tmp_path / "calib.json")[2])
    assert "a.png, b.png, c.png: the calibration is unlike that of any camera: fx 1.1" in told


def test_a_calibration_of_another_size_that_it_does_not_state_is_told(tmp_path: Path) -> None:
    (tmp_path / "calib.json").write_text(json.dumps({"K": MATRIX.tolist(), "dist": LENS}))
    photos = write_photos(tmp_path / "photos", size=(2 * W, 2 * H))
    (told,) = warnings_of(load(photos, tmp_path / "calib.json")[2])
    assert "states no image size, and its principal point (196, 152) is far from the middle of 800x600 pixels" in told
    assert not warnings_of(load(write_photos(tmp_path / "fitting"), tmp_path / "calib.json")[2])


@pytest.mark.parametrize(
    ("other", "name"),
    [
        ({"camera_model": CameraModel.OPENCV}, "camera_model"),
        ({"camera_params": (1.0, 2.0, 3.0, 4.0)}, "camera_params"),
        ({"focal_px": 500.0}, "focal_px"),
    ],
)
def test_nothing_else_may_say_what_the_camera_is(other: dict[str, Any], name: str) -> None:
    with pytest.raises(UsageError, match=rf"images.camera and images.{name}"):
        ImageOptions(camera="calib.json", **other)


def test_the_command_line_takes_one_of_both(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["reconstruct", str(tmp_path), "-o", str(tmp_path / "out"), "--camera", "c.yaml"]
    with pytest.raises(SystemExit, match="2"):
        main([*arguments, "--camera-model", "SIMPLE_RADIAL"])
    assert "--camera-model: not allowed with argument --camera" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("missing.yaml", None, "found no such file"),
        ("calib.json", json.dumps({"name": "left"}), "expected a calibration"),
        ("cameras.json", json.dumps({"cameras": []}), "expected a list of objects under cameras"),
        ("cameras.txt", "1 OPENCV 400 300 1 2\n", "OPENCV"),
        ("folder", "", "expected a folder with the cameras of a COLMAP model"),
    ],
)
def test_what_is_no_calibration_is_refused(tmp_path: Path, name: str, text: str | None, message: str) -> None:
    if text == "":
        (tmp_path / name).mkdir()
    elif text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message):
        load(write_photos(tmp_path / "photos"), tmp_path / name)


# ------------------------------------------------------------------------------------------------------- end to end


def through_lens(path: Path, k_matrix: np.ndarray, k1: float, camera: Camera) -> Image.Image:
    """A photograph of the sample, of twice the size, as a camera with another lens would have taken it."""
    double = Camera(camera.model, 2 * W, 2 * H, np.where(np.arange(8) < 4, 2.0, 1.0) * camera.params)
    grid = np.stack(np.meshgrid(np.arange(2 * W) + 0.5, np.arange(2 * H) + 0.5), -1).reshape(-1, 2)
    rays = pixels_to_normalized(double, grid)
    rays *= 1 + k1 * (rays**2).sum(1, keepdims=True)
    places = (rays @ k_matrix[:2, :2].T + k_matrix[:2, 2]).reshape(2 * H, 2 * W, 2).astype(np.float32)
    assert (places > -1).all()
    assert (places < [2 * W, 2 * H]).all(), "the picture shows more than the sample does"
    pixels = cv2.remap(np.asarray(Image.open(path)), places, None, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)
    return Image.fromarray(pixels).reduce(2)


@pytest.fixture(scope="module")
def courtyard(sample: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``cam0`` and ``cam1``: eight photographs of the sample through two strong lenses."""
    folder = tmp_path_factory.mktemp("courtyard")
    document = json.loads((sample / "cameras.json").read_text())
    for number, view in enumerate(document["cameras"][:8]):
        place = folder / f"cam{number % 2}"
        place.mkdir(exist_ok=True)
        picture = through_lens(
            sample / view["file"], np.array(view["K"]), view["dist"][0], (BARREL, FISHEYE)[number % 2]
        )
        picture.save(place / f"{Path(view['file']).stem}.png")
    return folder


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Callable[..., dict[str, Any]]:
    """Reconstruct by the command line; what it prints for programs."""

    def run(photos: Path, output: Path, *flags: str) -> dict[str, Any]:
        capsys.readouterr()
        assert main(["reconstruct", str(photos), "-o", str(output), "--no-recording", "--json", *flags]) == 0
        result: dict[str, Any] = json.loads(capsys.readouterr().out)
        return result

    return run


def test_two_calibrated_cameras_give_the_poses_that_are_true(
    courtyard: Path, sample: Path, tmp_path: Path, run: Callable[..., dict[str, Any]]
) -> None:
    calibration, output = tmp_path / "camchain.yaml", tmp_path / "out"
    calibration.write_text(PAIR)
    result = run(courtyard, output, "--camera", str(calibration))
    assert (result["num_registered"], result["contradictions"]) == (8, [])
    model, _ = read_model(output / "sparse" / "0")
    for name, idx in zip(model.image_names, model.image_camera_idx, strict=True):
        given, found = (BARREL, FISHEYE)[name.startswith("cam1")], model.cameras[idx]
        assert found.model == given.model
        # refined, it is over the whole picture still the lens that was given
        seen = pixels_to_normalized(given, np.mgrid[20:W:40, 20:H:40].reshape(2, -1).T + 0.5)
        rays = np.concatenate([seen, np.ones((len(seen), 1))], 1)
        assert np.abs(project(found, rays) - project(given, rays)).max() < 2.0
    errors = compare_with_ground_truth(output, sample)
    assert errors["rotation_error_deg"]["max"] < 0.1
    # half the error, and more, that there is where the lenses are to be found from so few photographs
    run(courtyard, tmp_path / "unknown")
    unknown = compare_with_ground_truth(tmp_path / "unknown", sample)
    assert errors["center_error"]["max"] < 0.5 * unknown["center_error"]["max"]

    # nothing is done again unless the calibration has changed
    assert run(courtyard, output, "--camera", str(calibration))["run"]["is_up_to_date"]
    calibration.write_text(PAIR.replace(str(FX), str(FX + 1.0)))
    result = run(courtyard, output, "--camera", str(calibration), "--set", "images.fix_intrinsics=true")
    assert not result["run"]["is_up_to_date"]
    model, _ = read_model(output / "sparse" / "0")
    assert sorted(camera.params[0] for camera in model.cameras) == [FX + 1.0, FISHEYE.params[0]]
