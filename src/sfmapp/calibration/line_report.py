"""What a calibration from lines says of itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from sfmapp.calibration.report import CameraFileReport
from sfmapp.reporting import Report

Verdict = Literal["measured", "left alone", "unknown"]


class LineParameter(Report):
    """A parameter, or what belongs together, and whether the lines tell it.

    Attributes:
        verdict: ``measured``; ``left alone`` where it is zero or the middle as far as lines show; ``unknown`` where
        they
            do not show it.
        value, sigma: in the unit that the name says.
        reason: the evidence, or what is missing.
    """

    name: str
    verdict: Verdict
    value: float
    sigma: float
    reason: str


class HeldOutLines(Report):
    """Lines that a calibration from the other half of the lines was asked about, both halves in turn.

    Attributes:
        num_bent: lines that the distortion found from the others bends by more than their points are off.
        bend_before_px, bend_after_px: rms distance of the points of these from the best straight line, without and with
            that distortion undone.
        num_met, num_lines: straight lines that meet a vanishing point of the others within two sigmas, of all straight
            ones; absent without directions.
        num_expected: that many would by chance.
        focal_shares: focal length of either half over that of all lines.
    """

    num_bent: int
    bend_before_px: float
    bend_after_px: float
    num_lines: int
    num_met: int | None = None
    num_expected: float | None = None
    focal_shares: Sequence[float] | None = None


class LineDirection(Report):
    """A direction of the world in one photograph.

    Attributes:
        direction: unit vector in the camera.
        vanishing_point: pixels of the photograph without distortion; absent where it is farther than 1e6 pixels.
        num_lines: that run along it.
    """

    direction: Sequence[float]
    num_lines: int
    vanishing_point: Sequence[float] | None = None


class LinePhotograph(Report):
    """One photograph.

    Attributes:
        num_arcs: of circles that were found in its edges.
        num_straight: of these, straight once the distortion is undone.
        directions: of its world; empty where none stand out.
        problem: why it was left aside.
    """

    name: str
    num_arcs: int
    num_straight: int
    directions: Sequence[LineDirection] = ()
    problem: str | None = None


class LinesReport(Report):
    """A calibration from lines.

    Attributes:
        mode: ``directions`` where a world of directions was found, ``plumb lines`` where lines are straight, and no
        more.
        parameters: distortion, focal length, principal point.
        strengths, votes: distortions lambda R^2 that were tried, and how many lines are straight with each.
        held_out: the evidence; absent where there were too few lines to hold any out.
        num_seeds: searches with other random numbers that came to the same.
    """

    mode: str
    parameters: Sequence[LineParameter]
    photographs: Sequence[LinePhotograph]
    strengths: Sequence[float]
    votes: Sequence[float]
    num_seeds: int
    warnings: Sequence[str]
    held_out: HeldOutLines | None = None
    files: Sequence[CameraFileReport] = ()
