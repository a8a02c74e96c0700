"""Cameras that are mounted together in the files that other programs read: Kalibr, OpenCV, COLMAP."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera_files.reading import read_calibration
from sfmapp.camera_files.writing import (
    WrittenCamera,
    difference_px,
    kalibr_section,
    number_list,
    opencv_matrix,
    terms_of,
)
from sfmapp.formats.atomic import replaced_file
from sfmapp.geometry import rigid3
from sfmapp.scene.rig import Rig


def write_rig_files(folder: Path, rig: Rig, names: Sequence[str]) -> list[WrittenCamera]:
    """Write a rig into a folder in every form that can hold it, and read each back.

    Args:
        names: of the cameras, in the files that have names.

    Returns:
        An entry for each of camchain.yaml (Kalibr), stereo.yaml (OpenCV, of two cameras) and rig_config.json (COLMAP).

    Raises:
        InputError: the folder cannot be written.
    """
    forms: tuple[tuple[str, str, Callable[[Rig, Sequence[str]], str | None]], ...] = (
        ("camchain.yaml", "Kalibr", _camchain),
        ("stereo.yaml", "OpenCV", _stereo),
        ("rig_config.json", "COLMAP", _rig_config),
    )
    written = []
    for file_name, program, text_of in forms:
        text, path = text_of(rig, names), folder / file_name
        if text is None:
            path.unlink(missing_ok=True)  # of an earlier run with other lenses
            what = "a rig of other than two cameras of one size and kind" if program == "OpenCV" else "these lenses"
            written.append(WrittenCamera(file_name, program, reason=f"{program} has no words for {what}"))
            continue
        with replaced_file(path) as beside:
            beside.write_text(text, encoding="utf-8")
        written.append(WrittenCamera(file_name, program, None if program == "COLMAP" else _difference_px(rig, path)))
    return written


def _difference_px(rig: Rig, path: Path) -> float:
    """Largest distance between a pixel of the first two cameras and where what was read back puts it: of the second
    camera as far as its pose turns and shifts what is a baseline away."""
    first = rig.cameras[:2]
    read = read_calibration(path, [(camera.width, camera.height) for camera in first]).rig
    worst = max(difference_px(one, two) for one, two in zip(first, read.cameras, strict=True))
    away = rigid3.compose(read.cam_from_rig[1], rigid3.inverse(rig.cam_from_rig[1]))
    turn = float(np.radians(rigid3.rotation_angle_deg(rigid3.rotation_matrix(away))))
    shift = float(np.linalg.norm(away[4:])) / max(float(np.linalg.norm(rig.cam_from_rig[1, 4:])), 1e-12)
    return max(worst, (turn + shift) * first[1].focal)


def _camchain(rig: Rig, names: Sequence[str]) -> str | None:
    text = ""
    for n, (camera, name) in enumerate(zip(rig.cameras, names, strict=True)):
        section = kalibr_section(camera, name)
        if section is None:
            return None
        text += f"cam{n}:\n{section}"
        if n:
            rows = pose_rows(rigid3.compose(rig.cam_from_rig[n], rigid3.inverse(rig.cam_from_rig[n - 1])))
            text += "  T_cn_cnm1:\n" + "".join(f"  - {number_list(row)}\n" for row in rows)
    return text


def pose_rows(pose: NDArray[np.float64]) -> list[list[float]]:
    """(4, 4) rows of the matrix of a pose (7,)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rigid3.rotation_matrix(pose), pose[4:]
    rows: list[list[float]] = matrix.tolist()
    return rows


def _stereo(rig: Rig, names: Sequence[str]) -> str | None:
    terms = [one for one in map(terms_of, rig.cameras) if one is not None]
    sizes = {(camera.width, camera.height) for camera in rig.cameras}
    if not (len(terms) == len(rig.cameras) == 2) or len(sizes) > 1 or terms[0].is_fisheye != terms[1].is_fisheye:
        return None
    ((width, height),) = sizes
    text = f"%YAML:1.0\n---\nimage_width: {width}\nimage_height: {height}\n"
    text += f"camera_model: {'fisheye' if terms[0].is_fisheye else 'pinhole'}\n"
    for n, one in enumerate(terms, 1):
        text += f"M{n}: {opencv_matrix(3, 3, one.matrix)}"
        text += f"D{n}: {opencv_matrix(1, len(one.coefficients), one.coefficients)}"
    rows = np.array(pose_rows(rig.cam_from_rig[1]))
    return (
        text + f"R: {opencv_matrix(3, 3, rows[:3, :3].ravel().tolist())}T: {opencv_matrix(3, 1, rows[:3, 3].tolist())}"
    )


def _rig_config(rig: Rig, names: Sequence[str]) -> str | None:
    if not all(camera.model.is_colmaps for camera in rig.cameras):
        return None
    cameras = []
    for n, (camera, name) in enumerate(zip(rig.cameras, names, strict=True)):
        x, y, z, w, *shift = rig.cam_from_rig[n].tolist()
        place = {"cam_from_rig_rotation": [w, x, y, z], "cam_from_rig_translation": shift}
        cameras.append({
            "image_prefix": f"{name}/", **({"ref_sensor": True} if n == 0 else place),
            "camera_model_name": camera.model.name, "camera_params": camera.params.tolist(),
        })  # fmt: skip
    return json.dumps([{"cameras": cameras}], indent=1) + "\n"
