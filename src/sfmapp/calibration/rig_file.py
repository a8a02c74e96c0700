"""``rig.json``: cameras that are mounted together, which ``--camera`` of odometry takes.

Each camera is a section ``cam0``, ``cam1``, ... in COLMAP's terms, with Kalibr's ``T_cn_cnm1``: all that
:mod:`sfmapp.camera_files` looks for. The covariance of everything stands beside them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.documents import write_document
from sfmapp.calibration.rig import PairCalibration, RigCalibration
from sfmapp.calibration.rig_report import RigCameraSection, RigHead, RigPair
from sfmapp.camera_files.reading import RIG_POSE_NAMES
from sfmapp.camera_files.rig_writing import pose_rows
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]

FORMAT = "sfmapp rig 1"
_SHAPE = ("bend_uu", "bend_vv", "bend_uv")


def write_rig(path: Path, found: RigCalibration) -> None:
    """Write ``rig.json``. Raises InputError if it cannot be written."""
    write_document(path, {**rig_head(found), **{f"cam{n}": one for n, one in enumerate(rig_cameras(found))}})


def rig_head(found: RigCalibration) -> RigHead:
    """All of a rig but its cameras."""
    return RigHead(
        format=FORMAT,
        num_shots=found.num_shots,
        noise_px=found.noise_px,
        degrees_of_freedom=found.degrees_of_freedom,
        widening=found.widening,
        pairs=[_pair(found, pair) for pair in found.pairs],
        warnings=list(found.warnings),
        world_from_board=found.world_from_board.tolist(),
        bend=None if found.bend is None else found.bend.tolist(),
        unknowns=_unknowns(found),
        covariance=found.covariance.tolist(),
    )


def rig_cameras(found: RigCalibration) -> list[RigCameraSection]:
    """The cameras of a rig."""
    sections = []
    for n, (name, one) in enumerate(zip(found.names, found.cameras, strict=True)):
        pose = found.rig.cam_from_rig[n]
        before = found.rig.cam_from_rig[n - 1]
        sections.append(RigCameraSection(
            name=name, model=one.camera.model.name, width=one.camera.width, height=one.camera.height,
            params=one.camera.params.tolist(), sigmas=one.sigmas.tolist(), cam_from_rig=pose.tolist(),
            pose_sigmas=np.sqrt(np.maximum(np.diag(found.pose_covariance(n)), 0.0)).tolist(), noise_px=one.noise_px,
            rms_px=one.rms_px, T_cn_cnm1=pose_rows(rigid3.compose(pose, rigid3.inverse(before))) if n else None,
        ))  # fmt: skip
    return sections


def _unknowns(found: RigCalibration) -> list[str]:
    names = [f"cam{n}.{name}" for n, one in enumerate(found.cameras) for name in one.param_names]
    names += [f"cam{n}.{name}" for n in range(1, len(found.cameras)) for name in RIG_POSE_NAMES]
    names += [f"board{n}.{name}" for n in range(1, len(found.world_from_board)) for name in RIG_POSE_NAMES]
    shapes = [] if found.bend is None else [f"board{n}.{name}" for n in range(len(found.bend)) for name in _SHAPE]
    return names + shapes


def _pair(found: RigCalibration, pair: PairCalibration) -> RigPair:
    (length, length_sigma), (turn, turn_sigma) = pair.baseline, pair.turn_deg
    camera = found.rig.cameras[pair.first]
    cells = epipolar_map(pair, (camera.width, camera.height))
    return RigPair(
        first=found.names[pair.first],
        second=found.names[pair.second],
        second_from_first=pair.second_from_first.tolist(),
        rotation=rigid3.rotation_matrix(pair.second_from_first).tolist(),
        covariance=pair.covariance.tolist(),
        baseline_m=length,
        baseline_sigma_m=length_sigma,
        turn_deg=turn,
        turn_sigma_deg=turn_sigma,
        essential=pair.essential.tolist(),
        fundamental=None if pair.fundamental is None else pair.fundamental.tolist(),
        num_points=len(pair.epipolar_px),
        epipolar_rms_px=pair.epipolar_rms_px if len(pair.epipolar_px) else None,
        epipolar_map=[[None if np.isnan(v) else v for v in row] for row in cells.tolist()],
        by_motion=pair.by_motion,
    )


def epipolar_map(pair: PairCalibration, size: tuple[int, int], shape: tuple[int, int] = (6, 4)) -> Array:
    """(rows, columns) rms of epipolar errors, pixels, by where they are in the first picture; NaN for fewer than 4."""
    cell = np.clip((pair.xy[0] / size * shape).astype(np.int64), 0, np.array(shape) - 1)
    at = cell[:, 1] * shape[0] + cell[:, 0]
    num = np.bincount(at, minlength=shape[0] * shape[1])
    total = np.bincount(at, pair.epipolar_px**2, minlength=shape[0] * shape[1])
    rms = np.sqrt(np.where(num >= 4, total / np.maximum(num, 1), np.nan))
    cells: Array = rms.reshape(shape[1], shape[0])
    return cells
