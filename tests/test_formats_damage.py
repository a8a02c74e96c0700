"""Text of others with lines and numbers spoilt: it is refused by name, or what is read can be true."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image

from sfmapp.camera.camera import Camera, CameraModel
from sfmapp.errors import InputError
from sfmapp.formats.bundler import read_bundler, write_bundler
from sfmapp.formats.colmap import read_model, write_model_text
from sfmapp.formats.flat_yaml import read_flat_yaml
from sfmapp.formats.ground_truth import read_ground_truth
from sfmapp.formats.nerfstudio import read_nerfstudio, write_nerfstudio
from sfmapp.formats.text_input import read_json_object
from sfmapp.formats.trajectory import read_tum, write_tum
from sfmapp.geometry import rigid3
from sfmapp.images.folder import describe_images
from sfmapp.images.image_set import ImageOptions
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.synthetic import make_scene, synthetic_rig
from sfmapp.sequences.kitti import read_kitti, write_kitti

CAMERA = Camera(CameraModel.RADIAL, 1001, 750, np.array([900.0, 500.5, 375.0, -0.08, 0.02]))
WORDS = (
    "nan", "inf", "-1", "0", "1e400", "1e308", "-1e300", "9" * 30, "0x10", "", "abc", "1_0", "-0", "4294967296", "٣",
    "[", "]", "{", "}", ":", "null", "true", '"', "#", "\u2028", "\0", "1,5",
)  # fmt: skip


def sound_model(model: Reconstruction) -> None:
    sound_poses(model.cam_from_world[model.is_registered])
    assert np.isfinite(model.point_xyz).all()
    assert len(set(model.image_names)) == len(model.image_names)
    for camera in model.cameras:
        assert min(camera.width, camera.height) > 0
        assert np.isfinite(camera.params).all()
        assert (camera.canonical[:2] > 0).all()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model.residuals_px()


def sound_poses(poses: NDArray[np.float64]) -> None:
    assert np.isfinite(poses).all()
    np.testing.assert_allclose(np.linalg.norm(poses[:, :4], axis=1), 1.0, atol=1e-9)


def ground_truth_of(rec: Reconstruction, path: Path) -> None:
    entries = [
        {"file": name, "K": CAMERA.k_matrix.tolist(), "dist": [0.1, 0, 0, 0], "t_w2c": pose[4:].tolist(),
         "R_w2c": rigid3.rotation_matrix(pose).tolist(), "width": 1001, "height": 750}
        for name, pose in zip(rec.image_names, rec.cam_from_world, strict=True)
    ]  # fmt: skip
    path.write_text(json.dumps({"cameras": entries}))


READERS: dict[str, Callable[[Path], object]] = {
    "bundle.out": lambda path: sound_model(read_bundler(path)),
    "bundle.out.list.txt": lambda path: sound_model(read_bundler(path.with_name("bundle.out"))),
    "transforms.json": lambda path: sound_model(read_nerfstudio(path)),
    "sparse_pc.ply": lambda path: sound_model(read_nerfstudio(path.with_name("transforms.json"))),
    "poses.txt": lambda path: sound_poses(read_kitti(path)),
    "trajectory.tum": lambda path: sound_poses(read_tum(path)[1]),
    "cameras.json": lambda path: sound_poses(read_ground_truth(path).cam_from_world),
    "camera.yaml": read_flat_yaml,
} | {
    f"model/{name}.txt": lambda path: sound_model(read_model(path.parent)[0])
    for name in ("cameras", "images", "points3D", "rigs", "frames")
}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("good")
    rec = make_scene(5, 4, 8, [CAMERA]).observed
    write_bundler(folder / "bundle.out", rec)
    write_nerfstudio(folder / "transforms.json", rec)
    write_kitti(folder / "poses.txt", rec.cam_from_world)
    write_tum(folder / "trajectory.tum", np.arange(4.0), rec.cam_from_world)
    ground_truth_of(rec, folder / "cameras.json")
    write_model_text(folder / "model", make_scene(0, 4, 8, rig=synthetic_rig()).observed)
    yaml = "%YAML:1.0\n---\nK: !!opencv-matrix\n  rows: 3\n  data: [1., 2.,\n    3.]\na: {b: 1, c: [x, 'y']}\nl:\n"
    (folder / "camera.yaml").write_text(yaml + ' - 1\n - d: 2\n   e: 3\n# c\nf: "q: r"\n')
    for name, read in READERS.items():
        read(folder / name)
    return folder


@st.composite
def spoilt(draw: st.DrawFn, text: str) -> str:
    """A line twice, moved or gone, or a word or number replaced."""
    for _ in range(draw(st.integers(1, 3))):
        lines = text.split("\n")
        at, other = (draw(st.integers(0, len(lines) - 1)) for _ in range(2))
        what = draw(st.sampled_from(["word", "word", "word", "insert", "remove", "comment", "cut"]))
        if what == "word":
            words = lines[at].split(" ")
            words[draw(st.integers(0, len(words) - 1))] = draw(st.sampled_from(WORDS))
            lines[at] = " ".join(words)
        elif what == "insert":
            lines.insert(at, lines[other])
        elif what == "remove" and len(lines) > 1:
            del lines[at]
        elif what == "comment":
            lines.insert(at, "# a comment")
        elif what == "cut":
            lines[at:] = [lines[at][: draw(st.integers(0, len(lines[at])))]]
        text = "\n".join(lines)
    return text


@pytest.mark.parametrize("name", list(READERS))
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_spoilt_text_is_refused_by_name_or_can_be_true(files: Path, name: str, data: st.DataObject) -> None:
    path = files / name
    good = path.read_bytes()
    try:
        path.write_bytes(data.draw(spoilt(good.decode(errors="surrogateescape"))).encode(errors="surrogateescape"))
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            READERS[name](path)
    except InputError as error:
        if str(path.parent) not in str(error):
            raise AssertionError(f"the message names no file: {error}") from error
    finally:
        path.write_bytes(good)


@pytest.mark.parametrize(
    ("name", "old", "new", "match"),
    [
        ("trajectory.tum", "\n1.0 ", "\n1.0 1_0 ", "expected 8 finite numbers"),
        ("poses.txt", "1.000000000e+00 ", "1_0 ", "expected 12 finite numbers"),
        ("bundle.out", "900.0 ", "9_00.0 ", "nothing but numbers"),
        ("transforms.json", '"fl_x": 900.0', '"fl_x": 900.0, "fl_x": 800.0', "'fl_x' twice"),
        ("cameras.json", "[[900.0, 0.0, 500.5]", "[[900.0, 0.0, 1e308]", "expected K in pixels"),
        ("cameras.json", "[[900.0", "[[0.0", "positive focal"),
        ("model/cameras.txt", "900.0 ", "9e300 ", "expected finite parameters"),
        ("model/rigs.txt", "CAMERA 2 1 ", "CAMERA 2 7 ", "whether a sensor has a pose"),
        ("model/frames.txt", "\n", " CAMERA 1 9\n", "expected the end of the line"),
    ],
)
def test_what_would_be_read_as_something_else(files: Path, name: str, old: str, new: str, match: str) -> None:
    path = files / name
    good = path.read_text()
    assert old in good
    try:
        head, sep, rest = good.partition("\n") if name.startswith("model/") else ("", "", good)  # not the comment
        path.write_text(head + sep + rest.replace(old, new, 1))
        with pytest.raises(InputError, match=match):
            READERS[name](path)
    finally:
        path.write_text(good)


def test_names_in_objects_are_unique_at_any_depth(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"a": [{"b": 1, "c": {"d": 1, "d": 2}}]}')
    with pytest.raises(InputError, match="'d' twice"):
        read_json_object(tmp_path / "a.json")


def test_names_that_lead_out_of_the_folder_are_not_followed(tmp_path: Path) -> None:
    """Names of models of others: pictures are read from there, and depth maps written beside them."""
    for name in ("inside/a.png", "outside/b.png"):
        (tmp_path / name).parent.mkdir()
        Image.new("RGB", (32, 32)).save(tmp_path / name)
    names = ["a.png", "../outside/b.png", f"{tmp_path}/outside/b.png", "x/../../outside/b.png"]
    records, missing = describe_images(tmp_path / "inside", names, ImageOptions())
    assert [record is not None for record in records] == [True, False, False, False]
    assert [name for name, _ in missing] == names[1:]
    assert all("leads out" in reason for _, reason in missing)
