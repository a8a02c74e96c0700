"""Folders that programs made of photographs: the pictures in them are copies, depths and previews, no photographs."""

from __future__ import annotations

import os
import re
from pathlib import Path

MANIFEST = "run.json"
FORMAT_NAME = "sfmapp workspace"
"""What the format of a manifest begins with, in every version of it."""
IN_MEMORY = "memory://photographs"
"""What stands in reports and manifests for the place of photographs that have none."""

# what commands put into a workspace, for one that is itself taken for a folder of photographs
_RESULTS = frozenset({"dense", "mesh", "sparse", "validation"})
_FORMAT = re.compile(rb'"format"\s*:\s*"' + FORMAT_NAME.encode())
_HEAD_BYTES = 4096  # the format is the first entry of every manifest
_ADVICE = "name it as the source if these are the photographs"


def is_workspace(folder: str | os.PathLike[str]) -> bool:
    """Whether a command of sfmapp, of any version, has written its results into a folder."""
    path = Path(folder) / MANIFEST
    try:
        if not path.is_file():
            return False
        with path.open("rb") as file:
            return _FORMAT.search(file.read(_HEAD_BYTES)) is not None
    except OSError:
        return False


def holds_results(folder: Path, root: Path) -> bool:
    """Whether a folder below ``root`` is a workspace of sfmapp, or what a workspace that is the root keeps there."""
    if is_workspace(folder):
        return True
    return folder.parent == root and folder.name in _RESULTS and is_workspace(root)


def foreign_product(folder: Path) -> str | None:
    """What other programs made the folder for, as a reason to leave it out; None if nothing tells of any."""
    parent = folder.parent
    # 3D Gaussian splatting's convert.py has COLMAP undistort input/ to images/ beside it
    is_undistorted = folder.name == "images" and (parent / "input").is_dir() and _is_for_stereo(parent)
    if _is_for_stereo(folder) or is_undistorted:
        return f"undistorted copies that COLMAP made for its dense stage: {_ADVICE}"
    if folder.name == "undistorted" and (parent / "reconstruction.json").is_file():
        return f"undistorted copies that OpenSfM made: {_ADVICE}"
    if folder.name.startswith("odm_") and (parent / "opensfm").is_dir():
        return f"results of OpenDroneMap: {_ADVICE}"
    is_project = (parent / "transforms.json").is_file() or (parent / "sparse").is_dir()
    if is_project and re.fullmatch(r"images_(2|4|8|16)", folder.name) and (parent / "images").is_dir():
        return f"smaller copies of the photographs in {parent.name}/images: {_ADVICE}"
    return None


def _is_for_stereo(folder: Path) -> bool:
    return any((folder / "stereo" / name).is_file() for name in ("patch-match.cfg", "fusion.cfg"))
