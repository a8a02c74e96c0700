"""Packages that are loaded late, where they are used, and what to say where one of them is not installed."""

from __future__ import annotations

from importlib import util

from sfmapp.errors import InputError

# How many threads the linear algebra beneath numpy and scipy uses, read when it is loaded.
BLAS_THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS")

# by what is imported: the distribution that brings it, and what needs it
_DISTRIBUTIONS = {
    "av": ("av", "reading videos"),
    "cv2": ("opencv-contrib-python-headless", "reading images"),
    "distributed": ("distributed", "work on a cluster"),
    "gtsam": ("gtsam", "adjusting with further factors"),
    "laspy": ("laspy[lazrs]", "writing LAS"),
    "lazrs": ("laspy[lazrs]", "writing LAZ"),
    "libusb_package": ("libusb-package", "making meshes"),
    "mcap": ("mcap", "reading MCAP files"),
    "open3d": ("open3d-cpu", "making meshes"),
    "pyproj": ("pyproj", "coordinate systems by EPSG code"),
    "pycolmap": ("pycolmap", "a second opinion by pycolmap"),
    "rerun": ("rerun-sdk", "recordings and live views"),
    "rosbags": ("rosbags", "reading bags of ROS"),
    "xatlas": ("xatlas", "packing textures"),
}


class MissingPackageError(InputError):
    """A package that a task needs is not installed. The advice is the command that installs it."""


def require(*modules: str) -> None:
    """Make sure that packages are there, without importing them: before work is begun that would be lost.

    Args:
        modules: names as they are imported, such as ``open3d``.

    Raises:
        MissingPackageError: one is not installed.
    """
    for module in modules:
        if util.find_spec(module) is None:
            raise _missing(module)


def missing_package(error: ModuleNotFoundError) -> MissingPackageError | None:
    """An import that failed as a failure with a name; None if it is of no package that sfmapp depends on."""
    module = (error.name or "").partition(".")[0]
    return _missing(module) if module in _DISTRIBUTIONS else None


def _missing(module: str) -> MissingPackageError:
    distribution, task = _DISTRIBUTIONS[module]
    return MissingPackageError(
        f"{task} needs the package {distribution}, which is not installed",
        f"pip install '{_requirement(distribution)}'",
    )


def _requirement(distribution: str) -> str:
    """The distribution with the versions that sfmapp asks for."""
    from importlib import metadata  # which brings all of email, and is needed for failures alone

    try:
        known = metadata.requires("sfmapp") or []
    except metadata.PackageNotFoundError:
        known = []
    for requirement in known:
        name = requirement.partition(";")[0].strip()
        if name.startswith(distribution) and not name[len(distribution) :][:1].isalnum():
            return name
    return distribution
