"""The matchers of rectified pairs that ours are measured beside: OpenCV's in this process, others in their own.

ELAS and pandora come from pip, but neither can be installed beside what sfmapp needs: their rows are measured by an
interpreter of a virtual environment that has them, which runs this very file.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]
Disparity = NDArray[np.float32]
# bits of pandora's validity mask that say that a pixel has no disparity
INVALID = 0b1111000011

Peer = Callable[[Picture, Picture, tuple[int, int]], Disparity]


def bm(*, tuned: bool) -> Peer:
    """StereoBM, by its defaults or with the tests of OpenCV's sample stereo_match."""
    import cv2

    def run(left: Picture, right: Picture, search: tuple[int, int]) -> Disparity:
        matcher = cv2.StereoBM.create(numDisparities=search[1], blockSize=9 if tuned else 21)
        matcher.setMinDisparity(search[0])
        if tuned:
            matcher.setPreFilterCap(31)
            matcher.setTextureThreshold(10)
            matcher.setUniquenessRatio(15)
            matcher.setSpeckleWindowSize(100)
            matcher.setSpeckleRange(32)
            matcher.setDisp12MaxDiff(1)
        return _floats(matcher.compute(gray(left), gray(right)), search)

    return run


def sgbm(mode: str, *, tuned: bool, colour: bool = True) -> Peer:
    """StereoSGBM in a mode of its own, by its defaults or as OpenCV's sample stereo_match has it."""
    import cv2

    def run(left: Picture, right: Picture, search: tuple[int, int]) -> Disparity:
        if not colour:
            left, right = gray(left), gray(right)
        window, channels = 3, left.shape[2] if left.ndim == 3 else 1
        settings: dict[str, int] = {}
        if tuned:
            settings = {
                "P1": 8 * channels * window**2, "P2": 32 * channels * window**2, "disp12MaxDiff": 1, "preFilterCap": 63,
                "uniquenessRatio": 10, "speckleWindowSize": 100, "speckleRange": 32,
            }  # fmt: skip
        matcher = cv2.StereoSGBM.create(
            minDisparity=search[0], numDisparities=search[1], blockSize=window,
            mode=getattr(cv2, f"STEREO_SGBM_{mode}"), **settings,
        )  # fmt: skip
        return _floats(matcher.compute(left, right), search)

    return run


def gray(picture: Picture) -> Picture:
    """(H, W) of a picture (H, W) or (H, W, 3) RGB."""
    import cv2

    if picture.ndim == 2:
        return picture
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), np.uint8)


def _floats(fixed: NDArray[np.int16], search: tuple[int, int]) -> Disparity:
    return np.where(fixed >= 16 * search[0], fixed / np.float32(16), np.nan).astype(np.float32)


OPENCV: dict[str, Peer] = {
    "StereoBM, defaults": bm(tuned=False),
    "StereoBM, sample": bm(tuned=True),
    "StereoSGBM, defaults": sgbm("MODE_SGBM", tuned=False),
    "StereoSGBM, sample": sgbm("MODE_SGBM", tuned=True),
    "StereoSGBM, sample, grey": sgbm("MODE_SGBM", tuned=True, colour=False),
    "StereoSGBM, MODE_HH": sgbm("MODE_HH", tuned=True),
}


def elas(preset: str) -> Peer:
    """ELAS (Geiger et al., ACCV 2010), by one of its two presets; it looks for disparities from zero on."""

    def run(left: Picture, right: Picture, search: tuple[int, int]) -> Disparity:
        import elas as module

        # its disparities begin at zero: the right picture is moved
        shift, width = min(search[0], 0), left.shape[1]
        if shift:
            right = np.ascontiguousarray(np.pad(right, ((0, 0), (0, -shift)), mode="edge")[:, -shift:])
        matcher = module.Elas()
        matcher.set_preset(getattr(module, preset))
        matcher.disp_min, matcher.disp_max = max(search[0], 0), search[0] + search[1] - 1 - shift
        found = np.asarray(matcher.process(left, right)[0], np.float32)[:, :width]
        return np.where(found >= 0, found + np.float32(shift), np.nan).astype(np.float32)

    return run


def pandora(left: Picture, right: Picture, search: tuple[int, int]) -> Disparity:
    """pandora (CNES): census 5 x 5, SGM of libSGM, parabolas, a median and cross-checking; its documented pipeline."""
    import pandora as module
    from pandora.check_configuration import check_conf
    from pandora.img_tools import create_dataset_from_inputs
    from pandora.state_machine import PandoraMachine
    from PIL import Image

    first, last = search[0], search[0] + search[1] - 1
    pipeline = {
        "matching_cost": {"matching_cost_method": "census", "window_size": 5, "subpix": 1},
        "optimization": {"optimization_method": "sgm", "penalty": {"penalty_method": "sgm_penalty"}},
        "disparity": {"disparity_method": "wta", "invalid_disparity": "NaN"},
        "refinement": {"refinement_method": "vfit"},
        "filter": {"filter_method": "median"},
        "validation": {"validation_method": "cross_checking_accurate"},
    }
    with tempfile.TemporaryDirectory() as folder:
        inputs = {}
        for side, picture, disparities in (("left", left, [-last, -first]), ("right", right, [first, last])):
            Image.fromarray(picture).save(f"{folder}/{side}.png")
            inputs[side] = {"img": f"{folder}/{side}.png", "disp": disparities, "nodata": -9999}
        module.import_plugin()
        machine = PandoraMachine()
        config = check_conf({"input": inputs, "pipeline": pipeline}, machine)
        sides = [create_dataset_from_inputs(config["input"][side]) for side in ("left", "right")]
        found, _ = module.run(machine, *sides, config)
    disparity = -found["disparity_map"].to_numpy().astype(np.float32)
    is_invalid = (found["validity_mask"].to_numpy().astype(np.int64) & INVALID) != 0
    return np.where(is_invalid, np.float32(np.nan), disparity).astype(np.float32)


ELSEWHERE: dict[str, Peer] = {
    "ELAS, robotics": elas("PRESET_ROBOTICS"),
    "ELAS, Middlebury": elas("PRESET_MIDDLEBURY"),
    "pandora, census SGM": pandora,
}


def run_elsewhere(
    python: Path, name: str, left: Picture, right: Picture, search: tuple[int, int]
) -> tuple[Disparity, float]:
    """The disparities that another interpreter's matcher finds, and its CPU seconds without starting.

    Raises:
        subprocess.CalledProcessError: it ended with an error, which it has said on standard error.
    """
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        np.savez(place / "pair.npz", left=gray(left), right=gray(right), search=np.array(search))
        subprocess.run([str(python), __file__, name, str(place)], check=True, stdout=sys.stderr)
        said: dict[str, Any] = json.loads((place / "said.json").read_text())
        return np.load(place / "found.npy"), float(said["cpu_s"])


def main() -> None:
    name, place = sys.argv[1], Path(sys.argv[2])
    with np.load(place / "pair.npz") as pair:
        left, right, search = pair["left"], pair["right"], tuple(int(n) for n in pair["search"])
    times = []
    for _ in range(2):  # the second is warm
        start = time.process_time()
        found = ELSEWHERE[name](left, right, (search[0], search[1]))
        times.append(time.process_time() - start)
    np.save(place / "found.npy", found)
    (place / "said.json").write_text(json.dumps({"cpu_s": min(times)}))


if __name__ == "__main__":
    main()
