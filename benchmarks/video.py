"""Reconstruction from videos: frames that are chosen beside every n-th frame of the same number, and pycolmap on both.

    python benchmarks/video.py
    python benchmarks/video.py --only "street 4" --work /tmp/films

Films are compressed by H.264 at the bit rate of a phone: the first 200 frames of KITTI 00, and rendered walks, flights
and drives with motion blur, the truth of which is exact. ``chosen`` is ``sfmapp reconstruct FILM``; ``every n-th`` the
same on a folder with as many frames at equal distances, in JPEG of the same quality. pycolmap takes the files of both,
and matches them exhaustively, where they are no more than 80.

A row has how many frames there were and are registered in the largest model; the root mean square of the errors of
their centres after a similarity, as a share of the size of the scene; rotations; focal length over the true one; CPU.
Error counts only beside the share of the film that is registered: a model of half of it is the easier one.

Thresholds were chosen on KITTI, on "room 5" and on a rendered walk that is not among these; how the pose of an initial
pair is found on "room 1"; the others were not looked at before.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cases import Row, measure_cases
from rendered_worlds import sequences
from rendered_worlds.rendering import Optics
from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.errors import NoReconstructionError
from sfmapp.evaluation.poses import evaluate_poses
from sfmapp.evaluation.second_opinion import SecondOpinionOptions, ask_second_opinion
from sfmapp.formats.colmap import read_model
from sfmapp.geometry import rigid3
from sfmapp.images.containers import DecodedFrame, decoded_frames, open_container, rgb_of
from sfmapp.pipelines.sparse.reconstruct import reconstruct
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.video.frames import frame_name
from sparse import DATA

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

# of a camera that is held in a hand
PHONE = Camera(CameraModel.PINHOLE, 640, 360, np.array([507.0, 507.0, 320.0, 180.0]))
DIM = Optics(exposure_s=0.016, sub_exposures=8)
BITS_PER_S = 2_500_000
# pycolmap matches all pairs: beyond so many frames that takes longer than everything else here
MOST_FOR_PEER = 80
BY_PEER = ", by pycolmap"


@dataclass(frozen=True)
class Film:
    """Frames in grey, their rate, true poses (N, 7) cam_from_world, and the true focal length in pixels."""

    frames: Callable[[], Iterator[Pixels]]
    fps: float
    truth: Array
    focal: float
    bits_per_s: int = BITS_PER_S


def kitti() -> Film:
    """The beginning of KITTI 00."""
    folder = DATA / "kitti00-200"
    files = sorted(path for path in (folder / "image_0").iterdir() if path.suffix in (".png", ".jpg", ".webp"))
    poses = np.loadtxt(folder / "poses.txt").reshape(-1, 3, 4)
    back = poses[:, :, :3].transpose(0, 2, 1)
    truth = rigid3.from_matrix(back, -np.einsum("nij,nj->ni", back, poses[:, :, 3]))
    return Film(lambda: (cv2.imread(str(file), 0) for file in files), 10.0, truth, 718.856, 6_000_000)


def rendered(sequence: sequences.RenderedSequence) -> Film:
    """A rendered sequence, by its first camera."""

    def frames() -> Iterator[Pixels]:
        with ThreadPoolExecutor(2) as pool:
            yield from pool.map(sequence.image, range(len(sequence)))

    fps = round(1 / float(np.median(np.diff(sequence.timestamps_s))))
    return Film(frames, fps, sequence.cam_from_world, float(sequence.rig.cameras[0].focal))


def stop_and_turn() -> Film:
    """A walk through a room that stands for 40 frames and, later, turns by 120 degrees on the spot."""
    walk = sequences.room(240, 1, Optics(exposure_s=0.016, sub_exposures=6), PHONE)
    return rendered(sequences.pan(sequences.stand(walk, 100, 40), 200, 30, 120.0))


def turn(seed: int, num: int, at: int, count: int, angle_deg: float) -> Film:
    """A walk through a room, in better light, that turns on the spot by so much, within so many frames."""
    walk = sequences.room(num, seed, Optics(exposure_s=0.010, sub_exposures=4), PHONE)
    return rendered(sequences.pan(walk, at, count, angle_deg))


FILMS: dict[str, Callable[[], Film]] = {
    "kitti00-200": kitti,
    "room 1, stands and turns": stop_and_turn,
    "room 5": lambda: rendered(sequences.room(360, 5, DIM, PHONE)),
    "street 4": lambda: rendered(sequences.street(200, 4)),
    "hall 3": lambda: rendered(sequences.hall(300, 3)),
    "room 8": lambda: rendered(sequences.room(240, 8, DIM, PHONE)),
    "room 21, turns first": lambda: turn(21, 130, 3, 70, 100.0),
    "room 22, turns slowly": lambda: turn(22, 140, 70, 60, 90.0),
}


def write_film(path: Path, film: Film) -> None:
    """Compress it by H.264, once."""
    import av

    if path.is_file():
        return
    beside = path.with_suffix(".part.mp4")
    with av.open(str(beside), "w") as container:
        stream: Any = None
        for image in film.frames():
            if stream is None:
                rate = Fraction(film.fps).limit_denominator(1000)
                stream = container.add_stream("libx264", rate=rate, options={"preset": "veryfast"})
                stream.height, stream.width = (side // 2 * 2 for side in image.shape)
                stream.pix_fmt, stream.bit_rate = "yuv420p", film.bits_per_s
            color = np.repeat(image[: stream.height, : stream.width, None], 3, axis=2)
            for packet in stream.encode(av.VideoFrame.from_ndarray(color, format="rgb24")):
                container.mux(packet)
        for packet in stream.encode(None):
            container.mux(packet)
    beside.replace(path)


def write_frames(film: Path, numbers: Iterable[int], folder: Path) -> None:
    """Some frames of a film as JPEG of the quality that chosen ones have."""
    from PIL import Image

    wanted = set(numbers)
    folder.mkdir(parents=True, exist_ok=True)
    container = open_container(str(film), is_stream=False)
    for number, item in enumerate(decoded_frames(container)):
        if number in wanted and isinstance(item, DecodedFrame):
            Image.fromarray(rgb_of(item)).save(folder / frame_name(number), "JPEG", quality=95, subsampling=0)
    container.close()


def errors(model: Reconstruction, film: Film) -> Row:
    """Of the registered frames of a model."""
    idx = model.registered_idx
    names = [model.image_names[i] for i in idx]
    numbers = np.array([int(re.findall(r"\d+", name)[-1]) for name in names])
    found = evaluate_poses(names, model.cam_from_world[idx], names, film.truth[numbers])
    share = np.sqrt(np.nanmean(found.center_error**2)) / found.scene_size
    return {
        "registered": len(names), "from": int(numbers.min()), "to": int(numbers.max()), "center_share": float(share),
        "focal": float(model.cameras[0].focal) / film.focal,
        "rotation_deg": float(np.nanmean(found.rotation_error_deg)),
    }  # fmt: skip


def ours(source: Path, out: Path, film: Film) -> Row:
    """Reconstruct a film or a folder."""
    try:
        found = reconstruct(source, out, record=False)
    except NoReconstructionError as error:
        return {"failed": str(error)}
    run, videos = found.report.run, found.report.stages.videos
    choosing = {"video_wall_s": sum(one.wall_s for one in videos)} if videos else {}
    return errors(found.reconstruction, film) | {"cpu_s": run.cpu_s, "wall_s": run.wall_s} | choosing


def theirs(folder: Path, out: Path, film: Film) -> Row:
    """pycolmap on a folder of frames of one camera."""
    names = sorted(path.name for path in folder.glob("*.jpg"))
    found = ask_second_opinion(folder, names, out, SecondOpinionOptions(camera_mode="single"))
    took = {"cpu_s": found.cpu_s, "wall_s": found.wall_s}
    if found.model_folder is None:
        return {"failed": "no model"} | took
    return errors(read_model(Path(found.model_folder))[0], film) | took


def measure(name: str, work: Path) -> Iterator[Row]:
    """Chosen and equally spaced frames of a film."""
    film, plain = FILMS[name](), re.sub(r"\W+", "-", name)
    path = work / f"{plain}.mp4"
    write_film(path, film)
    out = work / plain
    row = ours(path, out / "chosen", film)
    chosen = out / "chosen" / "images" / plain
    num = len(list(chosen.glob("*.jpg")))
    facts = {"case": name, "film": name, "frames": len(film.truth), "num": num}
    yield facts | {"how": "chosen", "who": "sfmapp"} | row
    spread = np.unique(np.linspace(0, len(film.truth) - 1, num).round().astype(int)).tolist()
    write_frames(path, spread, out / "spread")
    yield facts | {"how": "every n-th", "who": "sfmapp"} | ours(out / "spread", out / "every", film)


def measure_peer(name: str, work: Path) -> Iterator[Row]:
    """pycolmap on the frames that :func:`measure` has left of a film."""
    film, plain = FILMS[name](), re.sub(r"\W+", "-", name)
    out = work / plain
    for how, folder in (("chosen", out / "chosen" / "images" / plain), ("every n-th", out / "spread")):
        num = len(list(folder.glob("*.jpg")))
        facts = {"case": name + BY_PEER, "film": name, "frames": len(film.truth), "num": num, "how": how}
        if num <= MOST_FOR_PEER:
            yield facts | {"who": "pycolmap"} | theirs(folder, out / f"pycolmap-{how[:6]}", film)


def markdown(report: dict[str, Any]) -> str:
    """The table."""
    lines = [
        "# Reconstruction from videos", "", f"{report['date']}, {report['cpu']}, commit {report['commit']}.", "",
        "Centres: root mean square as a share of the size of the scene, of the registered frames; CPU seconds of the",
        "whole command, choosing included. See `benchmarks/video.py`.", "",
        "| film | frames | taken | how | who | registered | centres, % | rotations, deg | focal / true | CPU s |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for row in sorted(report["rows"], key=lambda row: list(FILMS).index(row["film"])):
        head = f"| {row['film']} | {row['frames']} | {row['num']} | {row['how']} | {row['who']} "
        if "failed" in row:
            lines.append(head + f"| none: {row['failed']} | | | | {row.get('cpu_s', 0):.0f} |")
        else:
            lines.append(
                head + f"| {row['registered']} | {100 * row['center_share']:.3f} | {row['rotation_deg']:.3f} | "
                f"{row['focal']:.4f} | {row['cpu_s']:.0f} |"
            )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    WORK = Path(tempfile.gettempdir()) / "sfmapp-films"
    WORK.mkdir(exist_ok=True)
    CASES = [*FILMS, *(name + BY_PEER for name in FILMS)]

    def measured(name: str) -> Iterator[Row]:
        """Of a case."""
        return measure_peer(name.removesuffix(BY_PEER), WORK) if name.endswith(BY_PEER) else measure(name, WORK)

    measure_cases("video", __doc__, CASES, measured, markdown)
