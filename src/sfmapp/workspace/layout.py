"""Names of what a workspace holds, and of the commands that write one."""

from __future__ import annotations

from sfmapp.images.products import FORMAT_NAME, MANIFEST

__all__ = [
    "CALIBRATE",
    "CARVE",
    "DENSE",
    "FORMAT",
    "LOCATE",
    "LOCK",
    "MANIFEST",
    "MASKS",
    "ODOMETRY",
    "PAGE",
    "PAIR",
    "PANORAMA",
    "RECONSTRUCT",
    "RECTIFY",
    "REFINE",
    "REPORT",
    "STEREO",
    "SWEEP",
    "TRANSFER",
    "UNCALIBRATED",
    "UNDISTORT",
    "USUAL_FOLDERS",
    "WARP",
]

FORMAT = f"{FORMAT_NAME} 1"
# the commands that write workspaces; manifests of before the second one name none
RECONSTRUCT, ODOMETRY, REFINE, DENSE, UNDISTORT = "reconstruct", "odometry", "refine", "dense", "undistort"
CALIBRATE, LOCATE, PAIR, PANORAMA = "calibrate", "locate", "pair", "panorama"
TRANSFER, UNCALIBRATED = "transfer", "uncalibrated"
WARP, RECTIFY, STEREO, CARVE, MASKS = "warp", "rectify", "stereo", "carve", "masks"
SWEEP = "sweep"
# a report for programs, and the page for people beside it
LOCK, REPORT, PAGE = ".lock", "report.json", "report.html"
# where the photographs of a COLMAP model are by its custom, from MODEL and from PROJECT/sparse/0
USUAL_FOLDERS = ("images", "../images", "../../images")
