"""ORB-SLAM3 on a sequence, by the wheel `pyorbslam3`, as a process of its own: it may crash, and is measured.

    pip install pyorbslam3                            # GPL-3: beside the project, no part of it
    export PYORBSLAM3_VOCAB=.../ORBvoc.txt            # its vocabulary, which the wheel does not hold
    python benchmarks/orb_slam3.py SEQUENCE OUT.txt --mono

Frames come at the rate of the sequence, as its own players give them: the mapping beside needs that time. It is not
deterministic. OUT.txt has one line for each frame with a pose: its time, and world_from_camera as tx ty tz qx qy qz qw.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.scene.rig import Rig
from sfmapp.sequences.open import SequenceOptions, open_sequence

# Its own settings for KITTI and for everything else.
_FEATURES, _WIDE_FEATURES, _WIDE_PX = 1250, 2000, 1000
_STEREO_DEPTH = 40.0  # baselines within which a point of a pair counts as near
_FIXED = """ORBextractor.scaleFactor: 1.2
ORBextractor.nLevels: 8
ORBextractor.iniThFAST: 20
ORBextractor.minThFAST: 7
Viewer.KeyFrameSize: 0.05
Viewer.KeyFrameLineWidth: 1.0
Viewer.GraphLineWidth: 0.9
Viewer.PointSize: 2.0
Viewer.CameraSize: 0.08
Viewer.CameraLineWidth: 3.0
Viewer.ViewpointX: 0.0
Viewer.ViewpointY: -0.7
Viewer.ViewpointZ: -1.8
Viewer.ViewpointF: 500.0
"""


def vocabulary() -> Path | None:
    """The file of words, where it is and the wheel is installed; it is not fetched."""
    found = Path(os.environ.get("PYORBSLAM3_VOCAB", ""))
    return found if found.is_file() and importlib.util.find_spec("pyorbslam3") is not None else None


def settings(rig: Rig, frames_per_second: float) -> str:
    """The settings file of a rig.

    Raises:
        ValueError: its lens is none that ORB-SLAM3 is given here: pinhole, or with radial and tangential distortion.
    """
    first, lines = rig.cameras[0], ["%YAML:1.0", 'File.version: "1.0"', 'Camera.type: "PinHole"']
    for number, camera in enumerate(rig.cameras[:2], 1):
        values = camera.canonical
        if camera.model.name not in ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"):
            raise ValueError(f"{camera.model.name}: expected a pinhole camera with at most k1, k2, p1, p2")
        # the centre of the top left pixel at (0, 0), as OpenCV has it; numbers with a point, or they are refused
        numbers = [*values[:2], *(values[2:4] - 0.5), *values[4:8]]
        lines += [
            f"Camera{number}.{name}: {value:#.10g}"
            for name, value in zip(("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"), numbers, strict=True)
        ]
    lines += [f"Camera.width: {first.width}", f"Camera.height: {first.height}"]
    lines += [f"Camera.fps: {round(frames_per_second)}", "Camera.RGB: 1"]
    if rig.is_stereo:
        first_from_second = [*rigid3.to_matrix(rigid3.inverse(rig.cam_from_rig[1])), (0.0, 0.0, 0.0, 1.0)]
        data = ",\n    ".join(", ".join(f"{v:#.10g}" for v in row) for row in first_from_second)
        lines += [f"Stereo.ThDepth: {_STEREO_DEPTH}", "Stereo.T_c1_c2: !!opencv-matrix"]
        lines += ["  rows: 4", "  cols: 4", "  dt: f", f"  data: [{data}]"]
    lines.append(f"ORBextractor.nFeatures: {_WIDE_FEATURES if first.width > _WIDE_PX else _FEATURES}")
    return "\n".join(lines) + "\n" + _FIXED


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("sequence", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--mono", action="store_true")
    parser.add_argument("--slow", type=float, default=1.0, help="times that of the sequence: beside busy neighbours")
    args = parser.parse_args()
    words = vocabulary()
    if words is None:
        raise SystemExit("expected the wheel pyorbslam3, and its vocabulary in PYORBSLAM3_VOCAB")
    import pyorbslam3

    sequence = open_sequence(args.sequence, SequenceOptions(mono=args.mono), Events())
    rate = sequence.frames_per_second or 30.0
    written = args.out.with_suffix(".yaml")
    written.write_text(settings(sequence.rig, rate), encoding="utf-8")
    sensor = pyorbslam3.Sensor.STEREO if sequence.rig.is_stereo else pyorbslam3.Sensor.MONOCULAR
    slam = pyorbslam3.Slam(words, written, sensor)
    begin, first = time.perf_counter(), None
    for frame in sequence.frames():
        first = frame.timestamp_s if first is None else first
        wait = args.slow * (frame.timestamp_s - first) - (time.perf_counter() - begin)
        if wait > 0:
            time.sleep(wait)
        track = slam.track_stereo if sequence.rig.is_stereo else slam.track_monocular
        track(*(np.array(image) for image in frame.images), frame.timestamp_s)
    slam.shutdown()
    saved = args.out.with_suffix(".euroc")
    slam.save_trajectory_euroc(str(saved))
    rows: NDArray[np.float64] = np.loadtxt(saved, ndmin=2)
    rows[:, 0] /= 1e9
    np.savetxt(args.out, rows, fmt="%.9f")


if __name__ == "__main__":
    main()
