"""open3d, loaded where it is used: its import takes seconds and two hundred megabytes."""

from __future__ import annotations

import ctypes
from typing import Any


def load_open3d() -> Any:
    """The module. Its wheel expects the system's libusb, which pip's ``libusb-package`` brings as well."""
    import libusb_package

    ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    import open3d

    return open3d
