"""From a calibrated rig to ``recording.rrd``: cameras where they sit, and the boards as each of them has them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.result import CameraCalibration, ViewFit
from sfmapp.geometry import rigid3
from sfmapp.scene.rig import Rig
from sfmapp.viewer.recording import RecordingReport, record_in_child
from sfmapp.viewer.rig_replay import RigReplay

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ShownView:
    """A board in a photograph of a rig: its camera, shot and outline (4, 3), and what the calibration leaves of it."""

    camera: int
    shot: int
    outline: Array
    fit: ViewFit


def record_rig(
    path: Path, rig: Rig, cameras: Sequence[tuple[str, CameraCalibration]], views: Sequence[ShownView],
    photographs: Mapping[tuple[int, str], str], title: str,
) -> RecordingReport:  # fmt: skip
    """Write a recording in a child process; never raises for what happens there.

    Args:
        cameras: names and calibrations.
        photographs: files by camera and name.
    """
    shown = sorted((view for view in views if view.fit.cam_from_target is not None), key=lambda view: view.shot)
    rows = [made.camera.canonical for _, made in cameras]
    corners = []
    for view in shown:
        assert view.fit.cam_from_target is not None
        rig_from_board = rigid3.compose(rigid3.inverse(rig.cam_from_rig[view.camera]), view.fit.cam_from_target)
        corners.append(rigid3.apply(rig_from_board, view.outline))
    nothing = np.zeros((0, 2))
    replay = RigReplay(
        title=title, names=[name for name, _ in cameras],
        sizes=np.array([(made.camera.width, made.camera.height) for _, made in cameras], np.float64),
        focals=np.array([row[:2] for row in rows]), centers=np.array([row[2:4] for row in rows]),
        cam_from_rig=rig.cam_from_rig, camera=np.array([view.camera for view in shown], np.int64),
        shot=np.array([view.shot for view in shown], np.int64), corners=np.array(corners).reshape(-1, 4, 3),
        ptr=np.concatenate([[0], np.cumsum([len(view.fit.xy) for view in shown])]).astype(np.int64),
        xy=np.concatenate([nothing, *(view.fit.xy for view in shown)]),
        residuals=np.concatenate([nothing, *(view.fit.residuals for view in shown)]),
        is_used=np.concatenate([np.zeros(0, np.bool_), *(view.fit.is_used for view in shown)]),
        paths=[photographs.get((view.camera, view.fit.name), "") for view in shown],
        problems=[view.fit.problem or "" for view in shown],
    )  # fmt: skip
    return record_in_child(path, "rig", lambda _: replay)
