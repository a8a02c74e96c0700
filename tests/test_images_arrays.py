"""Photographs in memory: the same pixels give the same features as files, and what is no picture is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import sfmapp
from sfmapp.camera.camera import Camera, CameraModel
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.features.extract import FeatureOptions, extract_features
from sfmapp.images.arrays import ArraySource, describe_source
from sfmapp.images.folder import ImageOptions, load_images
from sfmapp.images.pixels import read_picture


def noise(*shape: int, dtype: type = np.uint8, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)


def test_arrays_give_what_files_give(photos: Path) -> None:
    from_files, _ = load_images(photos, ImageOptions(), Events())
    arrays = {record.name: read_picture(record).rgb for record in from_files.images}
    in_memory, _ = describe_source(ArraySource(arrays, {}))
    assert in_memory.names == from_files.names
    assert in_memory.root is None
    assert from_files.root == photos
    assert [camera.params.tolist() for camera in in_memory.cameras] == [c.params.tolist() for c in from_files.cameras]
    options = FeatureOptions(max_num_features=500)
    expected, _ = extract_features(from_files, options, threads=2, events=Events())
    found, _ = extract_features(in_memory, options, threads=2, events=Events())
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.keypoints.tobytes() == theirs.keypoints.tobytes()
        assert ours.descriptors.tobytes() == theirs.descriptors.tobytes()
        assert ours.rgb.tobytes() == theirs.rgb.tobytes()


def test_the_root_is_known_of_folders_patterns_and_lists(photos: Path, tmp_path: Path) -> None:
    listed = tmp_path / "list.txt"
    listed.write_text("\n".join(str(path) for path in photos.iterdir()))
    for source in (photos, photos / "*.png", listed):
        image_set, _ = load_images(source, ImageOptions(), Events())
        assert image_set.root == photos
        assert all((photos / name).is_file() for name in image_set.names)


def test_masks_and_alpha_count() -> None:
    mask = np.ones((40, 60), np.uint8)
    mask[:, :30] = 0
    rgba = noise(40, 60, 4)
    rgba[:20, :, 3], rgba[20:, :, 3] = 255, 0
    images, _ = describe_source(
        ArraySource({"a": noise(40, 60), "b": rgba, "c": noise(40, 60, 3)}, {"a": mask, "b": mask})
    )
    pictures = [read_picture(record) for record in images.images]
    assert pictures[0].mask is not None
    assert pictures[0].mask.tolist() == (mask > 0).tolist()
    assert pictures[1].mask is not None
    assert pictures[1].mask.sum() == 20 * 30
    assert pictures[2].mask is None
    assert pictures[0].rgb.shape == pictures[1].rgb.shape == (40, 60, 3)


def test_deep_pixels_are_scaled_as_those_of_files() -> None:
    deep = noise(40, 60, dtype=np.uint16) >> 4
    deep[0, 0] = 4095
    picture = read_picture(describe_source(ArraySource({"a": deep}, {}))[0].images[0])
    np.testing.assert_allclose(picture.gray, deep / 4095 * 255, atol=0.5001)


def test_a_camera_that_is_given_counts_as_known() -> None:
    camera = Camera(CameraModel.PINHOLE, 60, 40, np.array([50.0, 51.0, 30.0, 20.0]))
    images = sfmapp.load_images({"a": noise(40, 60)}, camera=camera)
    assert images.cameras[0].focal_source == "user"
    assert images.cameras[0].focal_sigma == pytest.approx(0.01 * 50.5)
    assert images.camera_of(0).params.tolist() == camera.params.tolist()
    with pytest.raises(InputError, match="61x40 pixels, but its camera has 60x40"):
        sfmapp.load_images({"a": noise(40, 61)}, camera=camera)


@pytest.mark.parametrize(
    "array", [noise(40, 60, 2), noise(40), noise(40, 60).astype(float), noise(40, 60, dtype=np.int32), noise(0, 5), "a"]
)
def test_what_is_no_picture_is_refused(array: object) -> None:
    with pytest.raises(InputError, match="expected pixels"):
        describe_source(ArraySource({"a.jpg": array}, {}))  # type: ignore[dict-item]


@pytest.mark.parametrize("name", ["", "/a.jpg", "../a.jpg", "b/../../a.jpg"])
def test_names_stay_in_their_folder(name: str) -> None:
    with pytest.raises(InputError, match="relative to one folder"):
        describe_source(ArraySource({name: noise(40, 60)}, {}))


def test_a_source_that_changes_its_mind_is_found_out() -> None:
    images, masks = {"a": noise(40, 60)}, {"a": np.ones((40, 60), bool)}
    record = describe_source(ArraySource(images, masks))[0].images[0]
    masks["a"] = np.ones((40, 59), bool)
    with pytest.raises(InputError, match="mask of a: expected an array of shape"):
        read_picture(record)
    images["a"] = noise(41, 60)
    with pytest.raises(InputError, match="changed while in use"):
        read_picture(record)
