"""Settings files of SLAM systems: their cameras under the names that all other calibrations have."""

from __future__ import annotations

from typing import Any

from sfmapp.errors import InputError

# camodocal's names of the coefficients of Kannala and Brandt, whose first, of the angle itself, is 1
_KANNALA_BRANDT = {"k2": "k1", "k3": "k2", "k4": "k3", "k5": "k4", "mu": "fx", "mv": "fy", "u0": "cx", "v0": "cy"}


def orb_slam_fields(place: str, fields: dict[str, Any]) -> dict[str, Any]:
    """The fields of ORB-SLAM's settings (``Camera.fx``, ``Camera1.fx``); other fields as they are.

    A second camera and its place (``Stereo.T_c1_c2``, points of the second to the first) become the sections ``cam0``
    and ``cam1`` of Kalibr; baseline times focal length (``Camera.bf``) or the baseline (``Stereo.b``) a baseline in
    metres; the camera on the IMU (``IMU.T_b_c1``, ``Tbc``) EuRoC's ``T_BS``.

    Raises:
        InputError: settings whose camera is not that of the images.
    """
    if "Camera.fx" not in fields and "Camera1.fx" not in fields:
        return fields
    if "LEFT.K" in fields:
        raise InputError(
            f"{place}: expected the camera of the images, found the one of images that ORB-SLAM rectifies with LEFT.K "
            "and LEFT.D",
            "write K and distortion_coefficients of LEFT into a file, or give the calibration that they come from",
        )
    shared = _below(fields, "Camera.")
    first = shared | _below(fields, "Camera1.")
    for name in ("IMU.T_b_c1", "Tbc"):
        if name in fields:
            first["T_BS"] = fields[name]
    second = _below(fields, "Camera2.")
    if second and "Stereo.T_c1_c2" in fields:
        return {
            "cam0": first, "cam1": shared | second, "T_cam0_cam1": fields["Stereo.T_c1_c2"], "fps": shared.get("fps"),
        }  # fmt: skip
    if "Stereo.b" in fields:
        first["baseline"] = fields["Stereo.b"]
    elif _is_number(first.get("bf")) and _is_number(first.get("fx")) and first["fx"]:
        first["baseline"] = first["bf"] / first["fx"]
    return first


def vins_fields(place: str, fields: dict[str, Any]) -> dict[str, Any]:
    """The fields of a camera of VINS-Mono and VINS-Fusion (camodocal: ``projection_parameters``) by common names."""
    projection, distortion = fields.get("projection_parameters"), fields.get("distortion_parameters", {})
    if not isinstance(projection, dict) or not isinstance(distortion, dict):
        return fields
    if str(fields.get("model_type", "")).upper() == "KANNALA_BRANDT":
        projection = {_KANNALA_BRANDT.get(name, name): value for name, value in projection.items()}
    if "mirror_parameters" in fields:
        raise InputError(
            f"{place}: expected model_type PINHOLE or KANNALA_BRANDT, found mirror_parameters of a catadioptric camera",
            "calibrate with one of these, or undistort the images first",
        )
    return {**fields, **projection, **distortion}


def _below(fields: dict[str, Any], prefix: str) -> dict[str, Any]:
    return {key.removeprefix(prefix): value for key, value in fields.items() if key.startswith(prefix)}


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
