"""Write rendered sequences with exact ground truth to disk, laid out as the real data sets are.

    python benchmarks/render_sequences.py street --layout kitti --frames 300 OUT
    python benchmarks/render_sequences.py hall --layout euroc --frames 600 OUT
    python benchmarks/render_sequences.py room --layout tum --frames 1000 OUT --blackout 400:20

Edits are applied in the order in which they are given. Frames that repeat others byte for byte become hard links.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rendered_worlds import sequences as rendered
from rendered_worlds.sequences import RenderedSequence
from sfmapp.camera.camera import Camera
from sfmapp.formats.trajectory import write_kitti
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]

LAYOUTS = {"street": "kitti", "hall": "euroc", "room": "tum", "handheld": "tum"}
EUROC_START_NS = 1403636579763555584
TUM_START_S = 1305031910.765238


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("place", choices=sorted(LAYOUTS))
    parser.add_argument("out", type=Path, help="folder to write; must not exist")
    parser.add_argument(
        "--layout", choices=("kitti", "euroc", "tum"), help="default: that of the real data of its kind"
    )
    parser.add_argument("--frames", type=int, default=300, help="before the edits")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--mono", action="store_true", help="the first camera alone")
    parser.add_argument("--noise", type=float, help="standard deviation in grey levels")
    parser.add_argument("--blur", type=float, help="exposure in seconds; 0: no motion blur")
    parser.add_argument("--readout", type=float, help="seconds from the first row to the last; 0: a global shutter")
    parser.add_argument("--moving-cars", type=int, default=0, help="street: cars that come the other way")
    parser.add_argument("--threads", type=int, default=2)
    edit = {"action": "append", "dest": "edits", "metavar": "AT:COUNT"}
    for name, text in (("blackout", "COUNT frames from AT are black"),
                       ("stand", "the camera stands for COUNT more frames at AT"),
                       ("pan", "a turn of 90 degrees on the spot in COUNT more frames at AT"),
                       ("splice", "COUNT frames of another place come before AT"),
                       ("lose", "COUNT frames from AT are missing")):  # fmt: skip
        parser.add_argument(
            f"--{name}", type=lambda text, name=name: (name, *map(int, text.split(":"))), help=text, **edit
        )
    parser.add_argument("--every", type=lambda text: ("every", int(text), 0), help="keep every N-th frame", **edit)
    parser.add_argument(
        "--repeat", type=lambda text: ("repeat", int(text), 0), help="over and over, N frames in all", **edit
    )
    args = parser.parse_args()
    sequence = make(args)
    for kind, at, count in args.edits or []:
        sequence = edited(sequence, args, kind, at, count)
    args.out.mkdir(parents=True)
    start, cpu = time.perf_counter(), time.process_time()
    WRITERS[args.layout or LAYOUTS[args.place]](sequence, args.out, args.threads)
    wall, cpu = time.perf_counter() - start, time.process_time() - cpu
    print(f"{args.out}: {len(sequence)} frames, {wall:.0f} s, CPU {cpu:.0f} s")


def make(args: argparse.Namespace) -> RenderedSequence:
    """The sequence before its edits."""
    options: dict[str, Any] = {"moving_cars": args.moving_cars} if args.place == "street" else {}
    sequence: RenderedSequence = getattr(rendered, args.place)(args.frames, args.seed, **options)
    optics = sequence.optics
    if args.noise is not None:
        optics = replace(optics, noise_sigma=args.noise)
    if args.blur is not None:
        optics = replace(optics, exposure_s=args.blur, sub_exposures=16 if args.blur > 0 else 1)
    if args.readout is not None:
        optics = replace(optics, readout_s=args.readout)
    if args.mono:
        rig = replace(sequence.rig, cameras=sequence.rig.cameras[:1], cam_from_rig=sequence.rig.cam_from_rig[:1])
        sequence = replace(sequence, rig=rig)
    return replace(sequence, optics=optics)


def edited(sequence: RenderedSequence, args: argparse.Namespace, kind: str, at: int, count: int) -> RenderedSequence:
    if kind == "blackout":
        return rendered.blackout(sequence, at, count)
    if kind == "stand":
        return rendered.stand(sequence, at, count)
    if kind == "pan":
        return rendered.pan(sequence, at, count)
    if kind == "splice":
        elsewhere = rendered.room if args.place == "hall" else rendered.hall
        return rendered.splice(sequence, elsewhere(60 + count, args.seed + 1), at, count, first=60)
    if kind == "lose":
        return rendered.drop(sequence, np.arange(at, at + count))
    if kind == "every":
        return rendered.drop(sequence, np.flatnonzero(np.arange(len(sequence)) % at))
    return rendered.repeat(sequence, at)


def write_images(sequence: RenderedSequence, path_of: Callable[[int, int], Path], threads: int) -> None:
    """Render all frames; those that repeat an earlier one byte for byte are linked to it."""
    rows = np.column_stack([
        sequence.cam_from_world, sequence.motion, sequence.world_time_s, sequence.gain, sequence.noise_key,
        sequence.place,
    ])  # fmt: skip
    first: dict[bytes, int] = {}
    jobs, links = [], []
    for frame, row in enumerate(rows):
        original = first.setdefault(row.tobytes(), frame)
        for sensor in range(len(sequence.rig.cameras)):
            if original == frame:
                jobs.append((frame, sensor))
            else:
                links.append((path_of(original, sensor), path_of(frame, sensor)))

    def write(job: tuple[int, int]) -> None:
        path = path_of(*job)
        if not cv2.imwrite(str(path), sequence.image(*job), [cv2.IMWRITE_PNG_COMPRESSION, 1]):
            raise OSError(f"cannot write {path}")

    cv2.setNumThreads(1)
    with ThreadPoolExecutor(threads) as pool:
        for _ in pool.map(write, jobs):
            pass
    for original_path, path in links:
        os.link(original_path, path)


def opencv_intrinsics(camera: Camera) -> list[float]:
    """fx, fy, cx, cy with the centre of the top left pixel at (0, 0), as all three data sets have it."""
    fx, fy, cx, cy = camera.canonical[:4]
    return [float(fx), float(fy), float(cx) - 0.5, float(cy) - 0.5]


def write_kitti_layout(sequence: RenderedSequence, out: Path, threads: int) -> None:
    """KITTI odometry: image_0, image_1, calib.txt, times.txt; the ground truth in poses.txt. Rectified cameras only."""
    lines = []
    for i in range(4):  # the colour cameras sit where the grey ones do
        sensor = min(i % 2, len(sequence.rig.cameras) - 1)
        camera, pose = sequence.rig.cameras[sensor], sequence.rig.cam_from_rig[sensor]
        if camera.canonical[4:8].any() or np.abs(pose[:3]).max() > 0:
            raise SystemExit("the layout of KITTI holds rectified cameras only")
        fx, fy, cx, cy = opencv_intrinsics(camera)
        matrix = np.array([[fx, 0, cx, 0], [0, fy, cy, 0], [0, 0, 1, 0]])
        matrix[:, 3] = matrix[:, :3] @ pose[4:]
        lines.append(f"P{i}: " + " ".join(f"{v:.12e}" for v in matrix.ravel()) + "\n")
    (out / "calib.txt").write_text("".join(lines))
    (out / "times.txt").write_text("".join(f"{t:.6e}\n" for t in sequence.timestamps_s))
    write_kitti(out / "poses.txt", sequence.ground_truth)
    for sensor in range(len(sequence.rig.cameras)):
        (out / f"image_{sensor}").mkdir()
    write_images(sequence, lambda frame, sensor: out / f"image_{sensor}" / f"{frame:06d}.png", threads)


def write_tum_layout(sequence: RenderedSequence, out: Path, threads: int) -> None:
    """TUM RGB-D without depth: rgb, rgb.txt, groundtruth.txt; calib.json for the camera, which TUM does not ship."""
    names = [f"{TUM_START_S + t:.6f}" for t in sequence.timestamps_s]
    head = "# color images\n# file: 'rendered'\n# timestamp filename\n"
    (out / "rgb.txt").write_text(head + "".join(f"{name} rgb/{name}.png\n" for name in names))
    ground_truth = rigid3.inverse(sequence.ground_truth)
    rows = [
        f"{name} " + " ".join(f"{v:.9f}" for v in (*pose[4:], *pose[:4])) + "\n"
        for name, pose in zip(names, ground_truth, strict=True)
        if np.isfinite(pose).all()
    ]
    head = "# ground truth trajectory\n# file: 'rendered'\n# timestamp tx ty tz qx qy qz qw\n"
    (out / "groundtruth.txt").write_text(head + "".join(rows))
    camera = sequence.rig.cameras[0]
    calib = dict(zip(("fx", "fy", "cx", "cy"), opencv_intrinsics(camera), strict=True))
    calib |= {"width": camera.width, "height": camera.height}
    if camera.canonical[4:8].any():
        calib |= dict(zip(("k1", "k2", "p1", "p2"), camera.canonical[4:8].tolist(), strict=True))
    (out / "calib.json").write_text(json.dumps(calib, indent=1) + "\n")
    (out / "rgb").mkdir()
    write_images(sequence, lambda frame, _: out / "rgb" / f"{names[frame]}.png", threads)


def write_euroc_layout(sequence: RenderedSequence, out: Path, threads: int) -> None:
    """EuRoC: mav0 with cam0, cam1, imu0 and state_groundtruth_estimate0; times in nanoseconds."""
    mav = out / "mav0"
    stamps = EUROC_START_NS + np.rint(sequence.timestamps_s * 1e9).astype(np.int64)
    body_from_cam = rigid3.IDENTITY if sequence.imu_from_cam is None else sequence.imu_from_cam
    mav.mkdir()
    (mav / "body.yaml").write_text("%YAML:1.0\ncomment: rendered\n")
    for sensor, camera in enumerate(sequence.rig.cameras):
        folder = mav / f"cam{sensor}"
        (folder / "data").mkdir(parents=True)
        rows = "".join(f"{stamp},{stamp}.png\n" for stamp in stamps)
        (folder / "data.csv").write_text("#timestamp [ns],filename\n" + rows)
        pose = rigid3.compose(body_from_cam, rigid3.inverse(sequence.rig.cam_from_rig[sensor]))
        rate = 1 / np.median(np.diff(sequence.timestamps_s))
        (folder / "sensor.yaml").write_text(
            f"%YAML:1.0\n\nsensor_type: camera\ncomment: rendered cam{sensor}\n\n{_transform(pose)}\n"
            f"rate_hz: {rate:.6g}\n"
            f"resolution: [{camera.width}, {camera.height}]\ncamera_model: pinhole\n"
            f"intrinsics: {opencv_intrinsics(camera)} #fu, fv, cu, cv\ndistortion_model: radial-tangential\n"
            f"distortion_coefficients: {camera.canonical[4:8].tolist()}\n"
        )
    _write_inertia(sequence, mav, stamps)
    write_images(sequence, lambda frame, sensor: mav / f"cam{sensor}" / "data" / f"{stamps[frame]}.png", threads)


def _write_inertia(sequence: RenderedSequence, mav: Path, stamps: NDArray[np.int64]) -> None:
    """imu0 where there is one, and the true states of the body: at its samples, or else at the frames."""
    imu = sequence.imu
    known = np.isfinite(sequence.ground_truth).all(1)
    zeros = np.zeros((int(known.sum()), 6))
    times, world_from_body = stamps[known], rigid3.inverse(sequence.ground_truth[known])
    states = np.column_stack([sequence.motion[known, 3:], zeros])
    if imu is not None:
        times = EUROC_START_NS + np.rint(imu.timestamps_s * 1e9).astype(np.int64)
        world_from_body = rigid3.inverse(imu.imu_from_world)
        states = np.column_stack([imu.velocity, imu.gyro_bias, imu.accel_bias])
        (mav / "imu0").mkdir()
        (mav / "imu0" / "sensor.yaml").write_text(
            f"%YAML:1.0\n\n#Default imu sensor yaml file\nsensor_type: imu\ncomment: rendered IMU\n\n"
            f"{_transform(rigid3.IDENTITY)}\nrate_hz: {1 / np.median(np.diff(imu.timestamps_s)):.6g}\n\n"
            f"gyroscope_noise_density: {imu.gyro_noise}     # [ rad / s / sqrt(Hz) ]\n"
            f"gyroscope_random_walk: {imu.gyro_walk}       # [ rad / s^2 / sqrt(Hz) ]\n"
            f"accelerometer_noise_density: {imu.accel_noise}  # [ m / s^2 / sqrt(Hz) ]\n"
            f"accelerometer_random_walk: {imu.accel_walk}    # [ m / s^3 / sqrt(Hz) ]\n"
        )
        head = "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1]," \
               "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n"  # fmt: skip
        _write_csv(mav / "imu0" / "data.csv", head, times, np.column_stack([imu.gyro, imu.accel]))
    folder = mav / "state_groundtruth_estimate0"
    folder.mkdir()
    (folder / "sensor.yaml").write_text(
        f"%YAML:1.0\n\nsensor_type: visual-inertial\ncomment: the exact ground truth\n\n{_transform(rigid3.IDENTITY)}\n"
    )
    axes = ("p_RS_R_{} [m]", "q_RS_{} []", "v_RS_R_{} [m s^-1]", "b_w_RS_S_{} [rad s^-1]", "b_a_RS_S_{} [m s^-2]")
    names = [
        name.format(a)
        for name, letters in zip(axes, ("xyz", "wxyz", "xyz", "xyz", "xyz"), strict=True)
        for a in letters
    ]
    columns = np.column_stack([world_from_body[:, 4:], world_from_body[:, [3, 0, 1, 2]], states])
    _write_csv(folder / "data.csv", "#timestamp, " + ", ".join(names) + "\n", times, columns)


def _write_csv(path: Path, head: str, stamps: NDArray[np.int64], columns: Array) -> None:
    rows = (f"{stamp}," + ",".join(f"{v:.9g}" for v in row) + "\n" for stamp, row in zip(stamps, columns, strict=True))
    path.write_text(head + "".join(rows))


def _transform(body_from_sensor: Array) -> str:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rigid3.rotation_matrix(body_from_sensor), body_from_sensor[4:]
    numbers = ",\n         ".join(", ".join(f"{v:.12g}" for v in row) for row in matrix)
    return f"#Sensor extrinsics wrt. the body-frame.\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{numbers}]\n"


WRITERS: dict[str, Callable[[RenderedSequence, Path, int], None]] = {
    "kitti": write_kitti_layout,
    "euroc": write_euroc_layout,
    "tum": write_tum_layout,
}

if __name__ == "__main__":
    main()
