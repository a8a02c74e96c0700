"""``sfmapp panorama`` beside OpenCV's Stitcher and Hugin on the same photographs: rotations, focal length, seams, CPU
time.

    python benchmarks/panorama.py

pano-sponza-rot has exact rotations; three rings are rendered from a texture on a sphere, exactly as well: one by a lens
with distortion whose exposures differ by a factor of two, one with things that move and a stray photograph, and one of
two zooms, 1.5 apart, which no EXIF tells. The error at seams is that of where a pixel of one photograph is looked for
in its neighbour, by the cameras that were found against the true ones, over all of what both show. Both programs run in
a process of their own, with what they do to write the picture; the second run of ours is counted, when kernels are
compiled. Hugin is run by the commands of its own
assistant (pto_gen, cpfind, cpclean, autooptimiser, pano_modify, nona, enblend), and left out where they are not.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from machine import RESULTS, describe_machine
from sfmapp.camera.camera import Camera, pixels_to_rays, project
from sfmapp.camera.names import CameraModel
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]

# of the peer, as a process of its own
STITCHER = """
import glob, json, sys
import cv2
names = sorted(glob.glob(sys.argv[1] + "/*"))
stitcher = cv2.Stitcher_create(cv2.Stitcher_PANORAMA)
status, picture = stitcher.stitch([cv2.imread(name) for name in names])
found = {"status": status, "cameras": []}
if status == 0:
    cv2.imwrite(sys.argv[2] + ".jpg", picture)
    scale = stitcher.workScale()
    for k, camera in zip(stitcher.component(), stitcher.cameras()):
        found["cameras"].append({"name": names[k].rpartition("/")[2], "R": camera.R.tolist(), "scale": scale,
                                 "f": camera.focal, "c": [camera.ppx, camera.ppy], "aspect": camera.aspect})
json.dump(found, open(sys.argv[2] + ".json", "w"))
"""


def texture() -> NDArray[np.uint8]:
    """(2048, 4096, 3) all round."""
    rng = np.random.default_rng(5)
    total = np.zeros((2048, 4096, 3), np.float32)
    for size, weight in ((16, 1.0), (64, 0.8), (256, 0.7), (1024, 0.6), (2048, 0.4)):
        part = rng.normal(size=(size // 2, size, 3)).astype(np.float32)
        total += weight * cv2.resize(part, (4096, 2048), interpolation=cv2.INTER_CUBIC)
    return np.asarray(np.clip(120 + 40 * total, 0, 255), np.uint8)


def render(sphere: NDArray[np.uint8], camera: Camera, rotation: Array) -> NDArray[np.uint8]:
    """A photograph (H, W, 3) from the centre of the sphere."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = pixels_to_rays(camera, np.column_stack([x.ravel(), y.ravel()])) @ rotation
    u = (np.arctan2(rays[:, 0], rays[:, 2]) / np.pi + 1.0) * 2048 - 0.5
    v = (np.arcsin(rays[:, 1]) / np.pi + 0.5) * 2048 - 0.5
    place = np.stack([u, v], 1).astype(np.float32).reshape(camera.height, camera.width, 2)
    return np.asarray(cv2.remap(sphere, place, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP), np.uint8)


def ring(num: int, seed: int) -> Array:
    """(num, 3, 3) cam_from_world all round, held by hand."""
    rng = np.random.default_rng(seed)
    yaw = 2.0 * np.pi / num * np.arange(num)
    held = rigid3.exp_so3(0.03 * rng.normal(size=(num, 3)))
    return np.asarray(held @ rigid3.exp_so3(np.outer(-yaw, [0.0, 1.0, 0.0])), np.float64)


def make_rings(folder: Path) -> list[tuple[str, Path, dict[str, tuple[Camera, Array]]]]:
    """The rendered sets: name, folder, and by photograph its camera and rotation."""
    sphere, out = texture(), []
    lens = Camera(CameraModel.RADIAL, 640, 480, np.array([520.0, 320.0, 240.0, -0.12, 0.03]))
    plain = Camera(CameraModel.RADIAL, 640, 480, np.array([560.0, 320.0, 240.0, 0.0, 0.0]))
    for name, camera, seed in (
        ("distortion, exposures", lens, 1), ("moving things, a stray", plain, 2), ("two zooms", plain, 3),
    ):  # fmt: skip
        rng, truth = np.random.default_rng(seed), {}
        place = folder / str(seed)
        place.mkdir()
        for k, rotation in enumerate(ring(12, seed)):
            if seed == 3:
                camera = plain.with_focal(plain.focal * (1.5 if k % 3 == 2 else 1.0))
            pixels = render(sphere, camera, rotation)
            if seed == 1:
                gain = (1.0, 0.73, 0.85)[k % 3]  # of the stored values: light by a factor of two
                pixels = (pixels * gain).astype(np.uint8)
            elif seed == 2:
                x, y = int(rng.integers(40, 500)), int(rng.integers(150, 300))
                pixels = cv2.rectangle(pixels.copy(), (x, y), (x + 60, y + 150), (30, 30, 200), -1)
            truth[f"{k:02}.png"] = (camera, rotation)
            cv2.imwrite(str(place / f"{k:02}.png"), pixels)
        if seed == 2:
            cv2.imwrite(str(place / "stray.png"), render(np.ascontiguousarray(sphere[::-1, ::2]), camera, np.eye(3)))
        out.append((name, place, truth))
    return out


def sponza(root: Path) -> tuple[str, Path, dict[str, tuple[Camera, Array]]]:
    """The shared set."""
    found = json.loads((root / "pano-sponza-rot" / "gt.json").read_text())
    k = np.array(found["K"])
    camera = Camera(CameraModel.PINHOLE, 640, 480, np.array([k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5]))
    truth = {Path(e["file"]).name: (camera, np.array(e["R_cam_to_world"]).T) for e in found["cameras"]}
    return "pano-sponza-rot", root / "pano-sponza-rot" / "images", truth


def timed(command: list[str]) -> float:
    """CPU seconds of a process and its children; what it says goes to our errors."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=False, stdout=sys.stderr, timeout=900)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def ours(photos: Path, out: Path) -> tuple[float, dict[str, tuple[Camera, Array]]]:
    cpu_s = timed([sys.executable, "-m", "sfmapp", "panorama", str(photos), "-o", str(out), "-q"])
    if not (out / "rotations.json").is_file():
        return cpu_s, {}
    found = json.loads((out / "rotations.json").read_text())
    cameras = {
        each["camera_idx"]: Camera(CameraModel[each["model"]], each["width"], each["height"], np.array(each["params"]))
        for each in found["cameras"]
    }
    return cpu_s, {
        each["name"]: (cameras[each["camera"]], rigid3.rotation_matrix(each["cam_from_world"]))
        for each in found["images"]
    }


def theirs(photos: Path, out: Path) -> tuple[float, dict[str, tuple[Camera, Array]]]:
    cpu_s = timed([sys.executable, "-c", STITCHER, str(photos), str(out)])
    found = json.loads(out.with_suffix(".json").read_text())
    cameras = {}
    for each in found["cameras"]:
        params = np.array([each["f"], each["f"] * each["aspect"], *each["c"]]) / each["scale"] + [0, 0, 0.5, 0.5]
        cameras[each["name"]] = (Camera(CameraModel.PINHOLE, 640, 480, params), np.array(each["R"]).T)
    return cpu_s, cameras


HUGIN = (
    "pto_gen -o 1.pto {photos}/*",
    "cpfind --multirow -o 2.pto 1.pto",
    "cpclean -o 3.pto 2.pto",
    "autooptimiser -a -m -l -s -o 4.pto 3.pto",
    "pano_modify --canvas=AUTO --crop=AUTO -o 5.pto 4.pto",
    "nona -m TIFF_m -o part 5.pto",
    "enblend -o picture.tif part*.tif",
)


@dataclass(frozen=True)
class HuginLens:
    """A lens as Hugin has it: the radius in a photograph is a polynomial of that of a pinhole, in half heights."""

    width: int
    height: int
    focal: float
    powers: tuple[float, float, float]
    center: tuple[float, float]

    def project(self, rays: Array) -> Array:
        a, b, c = self.powers
        plane = self.focal * rays[:, :2] / rays[:, 2:]
        r = np.linalg.norm(plane, axis=1, keepdims=True) / (0.5 * min(self.width, self.height))
        scale = a * r**3 + b * r**2 + c * r + 1.0 - a - b - c
        # what is behind the camera, and beyond the corners, is not in the photograph
        known = (rays[:, 2:] > 0.0) & (r < 4.0)
        return np.where(known, plane * scale, np.nan) + self.center

    def rays(self, xy: Array) -> Array:
        apart = xy - self.center
        plane = apart
        for _ in range(50):
            rays = np.column_stack([plane / self.focal, np.ones(len(plane))])
            plane = plane - (self.project(rays) - self.center - apart)
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def hugin(photos: Path, out: Path) -> tuple[float, dict[str, tuple[HuginLens, Array]]]:
    """What Hugin finds of photographs of one lens; nothing if it fails."""
    out.mkdir()
    steps = " && ".join(HUGIN).format(photos=photos)
    cpu_s = timed(["bash", "-c", f"cd {out} && ({steps}) 2>&1 | tail -n 3"])
    found: dict[str, tuple[HuginLens, Array]] = {}
    if not (out / "picture.tif").is_file():
        return cpu_s, found
    joined = [line for line in (out / "5.pto").read_text().splitlines() if line.startswith("i ")]
    first = _numbers(joined[0])
    focal = 0.5 * first["w"] / np.tan(0.5 * np.radians(first["v"]))
    center = 0.5 * first["w"] + first["d"], 0.5 * first["h"] + first["e"]
    powers = first["a"], first["b"], first["c"]
    lens = HuginLens(int(first["w"]), int(first["h"]), focal, powers, center)
    used = {path.name for path in out.glob("part*.tif")}
    for k, line in enumerate(joined):
        numbers, name = _numbers(line), re.search(r'n"([^"]+)"', line)
        if name is not None and f"part{k:04}.tif" in used:
            y, p, r = (np.radians(numbers[each]) for each in "ypr")
            turned = rigid3.exp_so3([0.0, y, 0.0]) @ rigid3.exp_so3([p, 0.0, 0.0]) @ rigid3.exp_so3([0.0, 0.0, r])
            found[Path(name[1]).name] = lens, np.asarray(turned.T)
    return cpu_s, found


def _numbers(line: str) -> dict[str, float]:
    """Of a line of a project; what stands for a number of the first photograph is left out."""
    return {key: float(value) for key, value in re.findall(r" ([a-z])(-?[0-9][0-9.e+-]*)(?= )", line)}


def rays_of(camera: Camera | HuginLens, xy: Array) -> Array:
    return camera.rays(xy) if isinstance(camera, HuginLens) else pixels_to_rays(camera, xy)


def pixels_of(camera: Camera | HuginLens, rays: Array) -> Array:
    return camera.project(rays) if isinstance(camera, HuginLens) else project(camera, rays)


Found = dict[str, tuple[Camera | HuginLens, Array]]


def errors(found: Found, truth: dict[str, tuple[Camera, Array]]) -> dict[str, float]:
    """Against the truth: of rotations after one common one, of focal lengths, and where neighbours meet."""
    names = [name for name in truth if name in found]
    if len(names) < 2:
        return {"num_images": len(names), "num_strays": len(set(found) - set(truth))}
    mine, exact = (np.array([which[name][1] for name in names]) for which in (found, truth))
    u, _, vt = np.linalg.svd(np.einsum("nji,njk->ik", exact, mine))
    common = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    away = rigid3.rotation_angle_deg(mine @ (exact @ common).swapaxes(1, 2))
    focal = [abs(found[name][0].focal / truth[name][0].focal - 1.0) for name in names]
    apart = np.concatenate([_seam(found[a] + found[b], truth[a] + truth[b]) for a in names for b in names if a != b])
    return {
        "num_images": len(names), "num_strays": len(set(found) - set(truth)), "rotation_deg": float(away.max()),
        "focal_percent": 100.0 * float(max(focal)), "seam_rms_px": float(np.sqrt((apart**2).mean())),
        "seam_p95_px": float(np.percentile(apart, 95)),
    }  # fmt: skip


def _seam(found: tuple[Any, ...], truth: tuple[Any, ...]) -> Array:
    """(N,) distances, pixels, of where pixels of the first photograph are looked for in the second."""
    x, y = np.meshgrid(np.arange(10.0, 640.0, 20.0), np.arange(10.0, 480.0, 20.0))
    xy = np.column_stack([x.ravel(), y.ravel()])
    places = [pixels_of(each[2], rays_of(each[0], xy) @ each[1] @ each[3].T) for each in (truth, found)]
    shown = ((places[0] > 0) & (places[0] < [640, 480])).all(1)
    apart = np.linalg.norm(places[0] - places[1], axis=1)[shown]
    return np.where(np.isfinite(apart), apart, 640.0)


def measure() -> dict[str, Any]:
    """All sets, the programs in turns."""
    programs: dict[str, Any] = {"sfmapp": ours, "OpenCV": theirs}
    missing = [name for name in (step.split()[0] for step in HUGIN) if shutil.which(name) is None]
    if missing:
        print(f"Hugin is left out: {', '.join(missing)} not found (apt install hugin-tools enblend)", file=sys.stderr)
    else:
        programs["Hugin"] = hugin
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sets = make_rings(folder)
        if "SFMAPP_DATA" in os.environ:
            sets.insert(0, sponza(Path(os.environ["SFMAPP_DATA"])))
        ours(sets[-1][1], folder / "warm")
        for n, (title, photos, truth) in enumerate(sets):
            for program, run in programs.items():
                cpu_s, found = run(photos, folder / f"{n}-{program}")
                rows.append({"set": title, "program": program, "cpu_s": cpu_s, "num_true": len(truth),
                             **errors(found, truth)})  # fmt: skip
                print(rows[-1], file=sys.stderr)
    return {**describe_machine(), "runs": rows}


def write(report: dict[str, Any]) -> None:
    """The table of the results."""
    keys = (
        "num_images",
        "num_true",
        "num_strays",
        "rotation_deg",
        "focal_percent",
        "seam_rms_px",
        "seam_p95_px",
        "cpu_s",
    )
    head = (
        "set",
        "program",
        "photographs",
        "of",
        "strays",
        "turn, deg",
        "focal, %",
        "seams rms, px",
        "95 %, px",
        "CPU s",
    )
    machine = f"{report['date']}, commit {report['commit']}, {report['cpu']}, {report['cores']} cores."
    lines = ["# Panoramas", "", machine, "", f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for run in report["runs"]:
        cells = ["" if run.get(key) is None else f"{run[key]:.4g}" for key in keys]
        lines.append(f"| {run['set']} | {run['program']} | {' | '.join(cells)} |")
    (RESULTS / "panorama.md").write_text("\n".join(lines) + "\n")
    (RESULTS / "panorama.json").write_text(json.dumps(report, indent=1) + "\n")


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    write(measure())


if __name__ == "__main__":
    main()
