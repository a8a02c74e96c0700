"""Features of one image as a file, for those who do not share a memory: arrays as they are, nothing that is run."""

from __future__ import annotations

import hashlib
import zipfile
from pathlib import Path

import numpy as np

from sfmapp.errors import InputError
from sfmapp.formats.atomic import replaced_file
from sfmapp.scene.features import DescriptorMetric, Features


def feature_file(folder: Path, name: str) -> Path:
    """Where the features of an image are in a folder; ``name``: of the image, which may hold slashes."""
    return folder / f"{hashlib.blake2b(name.encode('utf-8', 'surrogateescape'), digest_size=16).hexdigest()}.npz"


def write_feature_file(path: Path, features: Features) -> None:
    """Write features, whole or not at all.

    Raises:
        InputError: the folder cannot be written.
    """
    arrays = {
        "keypoints": features.keypoints, "descriptors": features.descriptors, "rgb": features.rgb,
        "metric": np.array(str(features.metric)),
    }  # fmt: skip
    if features.is_dark is not None:
        arrays["is_dark"] = features.is_dark
    with replaced_file(path) as beside, beside.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def read_feature_file(path: Path) -> Features:
    """Features that :func:`write_feature_file` has written.

    Raises:
        InputError: the file is not there, or is not one of these.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return Features(
                arrays["keypoints"], arrays["descriptors"], arrays["rgb"], DescriptorMetric(str(arrays["metric"])),
                arrays.get("is_dark"),
            )  # fmt: skip
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: expected the features of an image: {error}") from error
