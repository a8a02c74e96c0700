"""Points triangulated from poses that are known, ours beside pycolmap's, on photographs with laser-registered cameras.

    SFMAPP_DATA=... python benchmarks/known_poses.py        writes results/known_poses.md

Both get the same cameras and poses, hold them, and find features and matches themselves; each runs in a process of its
own, one after the other, with the same cores.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from machine import RESULTS, describe_machine
from sfmapp.formats.colmap import read_model
from sfmapp.formats.ground_truth import read_ground_truth

SETS = ("herz-jesus-P8", "fountain-P11")


def run_pycolmap(folder: Path, output: Path) -> None:
    """Extract, match and triangulate with pycolmap at its defaults; its model is left in ``output/model``."""
    import pycolmap

    truth = read_ground_truth(folder)
    assert truth.cameras is not None
    names, database = [Path(name).name for name in truth.names], output / "database.db"
    camera = truth.cameras[0]
    reader, extraction, matching = (
        pycolmap.ImageReaderOptions(), pycolmap.FeatureExtractionOptions(), pycolmap.FeatureMatchingOptions(),
    )  # fmt: skip
    extraction.use_gpu = matching.use_gpu = False
    reader.camera_model, reader.camera_params = camera.model.name, ", ".join(map(repr, camera.params.tolist()))
    images = folder / "images"
    pycolmap.extract_features(
        database, images, names, pycolmap.CameraMode.SINGLE, reader, extraction, pycolmap.Device.cpu
    )
    pycolmap.match_exhaustive(database, matching_options=matching, device=pycolmap.Device.cpu)
    known = output / "known"
    known.mkdir()
    with pycolmap.Database.open(database) as opened:
        number = {image.name: image.image_id for image in opened.read_all_images()}
        camera_id = opened.read_all_cameras()[0].camera_id
    params = " ".join(map(repr, camera.params.tolist()))
    (known / "cameras.txt").write_text(f"{camera_id} {camera.model.name} {camera.width} {camera.height} {params}\n")
    lines = []
    for name, pose in zip(names, truth.cam_from_world[:, [3, 0, 1, 2, 4, 5, 6]].tolist(), strict=True):
        lines.append(f"{number[name]} {' '.join(map(repr, pose))} {camera_id} {name}\n\n")
    (known / "images.txt").write_text("".join(lines))
    (known / "points3D.txt").write_text("")
    (output / "model").mkdir()
    pycolmap.triangulate_points(pycolmap.Reconstruction(known), database, images, output / "model")


def measure(command: list[str], model: Path) -> list[str]:
    """Cells of a row: CPU seconds of a command, and what is said of its model by the same code for both."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    found = read_model(model)[0]
    summary = found.summary()
    length = np.bincount(found.tracks.obs_track_idx[found.obs_is_inlier], minlength=found.tracks.num_tracks)
    errors = np.linalg.norm(found.residuals_px()[found.obs_is_inlier], axis=1)
    return [
        str(summary.num_points), str(int((length >= 3).sum())), f"{summary.mean_track_length:.2f}",
        f"{errors.mean():.3f}", f"{np.median(errors):.3f}", f"{cpu:.1f}",
    ]  # fmt: skip


def main() -> None:
    data, rows = Path(os.environ["SFMAPP_DATA"]), []
    for name in SETS:
        folder = data / name
        with tempfile.TemporaryDirectory() as scratch:
            output = Path(scratch)
            theirs = [sys.executable, __file__, str(folder), str(output)]
            rows.append([name, "pycolmap", *measure(theirs, output / "model")])
            cameras = str(folder / "cameras.json")
            ours = [sys.executable, "-m", "sfmapp", "reconstruct", str(folder / "images"), "-o", str(output / "ours")]
            ours += ["--pose-priors", cameras, "--camera", cameras, "--fix-poses", "--no-recording", "-q"]
            ours += ["--set", "images.fix_intrinsics=true"]
            rows.append([name, "sfmapp", *measure(ours, output / "ours" / "sparse" / "0")])
            print(*rows[-2:], sep="\n", flush=True)
    machine = describe_machine()
    lines = [
        "# Points from known poses", "",
        "`benchmarks/known_poses.py`: laser-registered cameras held by both, features and matches of each its own.",
        f"Errors in pixels, of the observations that each kept. {machine['date']}, commit {machine['commit']}, "
        f"pycolmap {machine['versions']['pycolmap']}, {machine['cores']} cores.", "",
        "| set | program | points | in three photographs or more | track length | mean error | median error | CPU s |",
        "|---|---|---|---|---|---|---|---|",
        *(f"| {' | '.join(row)} |" for row in rows),
    ]  # fmt: skip
    (RESULTS / "known_poses.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    if len(sys.argv) == 3:
        run_pycolmap(Path(sys.argv[1]), Path(sys.argv[2]))
    else:
        main()
