"""What ``sfmapp locate --model`` says of photographs in a finished model, and its page."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from sfmapp.calibration.point_reports import PoseReport
from sfmapp.report.model import RunUsage
from sfmapp.report.page import render_page, table
from sfmapp.report.top_view import top_view_svg
from sfmapp.reporting import Report, Usage
from sfmapp.scene.reconstruction import Reconstruction

_NAMED = 3


class LandmarksReport(Report):
    """What was looked for where a pose puts it.

    Attributes:
        num_clusters: neighbouring points of photographs that were taken beside it, cluster by cluster.
        num_missing: clusters that are not there.
        support: logarithm of how much likelier that is in the right place than in a wrong one.
    """

    num_clusters: int
    num_missing: int
    support: float


class LocatedPhotographReport(Report):
    """A photograph in a model.

    Attributes:
        name: of it. reason: why it is not located, with the numbers; empty if it is.
        same_as: a photograph of the model that is the same file; it was left out of the search.
        pose: with its sigmas. covariance: (6, 6) of the pose, rotation (radians) and translation of
            ``x_cam <- exp(w) x_cam + v``.
        camera, params: its lens and that one's parameters, in COLMAP's order; camera_source: where they are from.
        num_points, num_correspondences: points of the model that agree with the pose, and that its matches tell.
        rms_px: of the residuals of those that agree.
        landmarks: absent where the photographs of the model are gone, or none was taken from beside it.
        matched_with: photographs of the model, most matches first. num_tried: how many were compared with it.
        took: what it cost.
    """

    name: str
    reason: str
    same_as: str | None = None
    pose: PoseReport | None = None
    covariance: Sequence[Sequence[float]] | None = None
    camera: str
    params: Sequence[float]
    camera_source: str
    num_points: int
    num_correspondences: int
    rms_px: float | None = None
    landmarks: LandmarksReport | None = None
    matched_with: Sequence[str]
    num_tried: int
    took: Usage

    @property
    def text(self) -> str:
        """In words, after its name."""
        if self.pose is None or self.rms_px is None:
            return f"not located: {self.reason}"
        center = ", ".join(
            f"{axis} {value:.6g} +- {sigma:.2g}"
            for axis, value, sigma in zip("xyz", self.pose.center, self.pose.sigma_center, strict=True)
        )
        return (
            f"{center} {self.pose.unit}, its rotation to {max(self.pose.sigma_rotation_deg):.2g} degrees; "
            f"{self.num_points} of {self.num_correspondences} points agree, rms {self.rms_px:.2f} px"
        )


class LocatedReport(Report):
    """The report of ``sfmapp locate --model``.

    Attributes:
        model: the folder of the reconstruction.
        num_images: photographs of its largest model.
        photographs: in the order of their names.
        skipped: files that are no photographs, and why.
        warnings: what speaks against the model itself.
    """

    model: str
    num_images: int
    photographs: Sequence[LocatedPhotographReport]
    skipped: Sequence[Sequence[str]]
    warnings: Sequence[str]
    run: RunUsage

    @property
    def num_located(self) -> int:
        """How many have a pose."""
        return sum(one.pose is not None for one in self.photographs)


def render_located_html(report: LocatedReport, model: Reconstruction) -> str:
    """The page: each photograph, and the model from above with those that were found.

    Args:
        model: the model that they were found in.
    """
    found = [one for one in report.photographs if one.pose is not None]
    rows = []
    for one in report.photographs:
        center = [""] * 3 if one.pose is None else [
            f"{value:.5g} +- {sigma:.1g}" for value, sigma in zip(one.pose.center, one.pose.sigma_center, strict=True)
        ]  # fmt: skip
        turn = None if one.pose is None else f"{max(one.pose.sigma_rotation_deg):.2g}"
        beside = ", ".join(one.matched_with[:_NAMED])
        marks = one.landmarks
        seen = None if marks is None else f"{marks.num_clusters - marks.num_missing} of {marks.num_clusters}"
        rows.append(
            [("t green" if one.pose else "t red", one.name),
             ("w", one.reason or (f"the same file as {one.same_as}; " if one.same_as else "") + f"beside {beside}"),
             ("", f"{one.num_points} of {one.num_correspondences}"), ("", seen), *(("", value) for value in center),
             ("", turn), ("", f"{one.took.wall_s:.1f}")]
        )  # fmt: skip
    unit = found[0].pose.unit if found and found[0].pose is not None else "units"
    head = [("t", "photograph"), ("t", ""), ("", "points that agree"), ("", "landmarks in place"),
            *(("", f"{axis}, {unit}") for axis in "xyz"), ("", "rotation, degrees"), ("", "s")]  # fmt: skip
    warnings = "".join(f"<li>{escape(warning)}</li>" for warning in report.warnings)
    light = "green" if len(found) == len(report.photographs) and not warnings else "amber" if found else "red"
    parts = [
        f'<p class="{light}">{len(found)} of {len(report.photographs)} photographs located among {report.num_images} '
        f"of {escape(report.model)}</p>{f'<ul>{warnings}</ul>' if warnings else ''}",
        table(head, rows),
        "<h2>From above</h2><p class=dim>photographs of the model in red, those that were located in blue</p>"
        + top_view_svg(with_located(model, found), new=len(found)),
    ]
    return render_page("Located photographs", parts)


def with_located(model: Reconstruction, found: Sequence[LocatedPhotographReport]) -> Reconstruction:
    """A model with cameras for what was located in it, for drawing."""
    poses = np.array([one.pose.cam_from_world for one in found if one.pose is not None]).reshape(-1, 7)
    drawn = model.copy()
    drawn.image_names = [*model.image_names, *(one.name for one in found)]
    drawn.cam_from_world = np.concatenate([model.cam_from_world, poses])
    drawn.image_camera_idx = np.append(model.image_camera_idx, np.zeros(len(poses), np.int32))
    return drawn
