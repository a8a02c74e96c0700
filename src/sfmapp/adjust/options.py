"""Options and report of a bundle adjustment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from sfmapp.option_checks import Range, check_options, positive
from sfmapp.reporting import Report

Loss = Literal["trivial", "huber", "cauchy"]

# Where the loss begins to bend, in standard deviations: at 2.4 it is 95 % efficient, and a little lower it sheds tails.
_LOSS_SIGMAS = 2.0
# A residual whose robust weight is below this is called rejected. With Cauchy's loss at two standard deviations that is
# beyond 3.5 of them, which happens to one in 400 of two Gaussian coordinates.
REJECTED_WEIGHT = 0.25
_RANGES = {
    "loss_scale_px": positive(),
    "max_iterations": Range(1, 100_000),
    "relative_cost_tolerance": Range(0.0, 1.0),
    "settled_sigmas": Range(0.0, 1.0),
    "initial_damping": positive(),
    "principal_point_sigma_px": positive(),
    "distortion_sigma": positive(),
}


@dataclass(frozen=True)
class AdjustOptions:
    """Options of a bundle adjustment. Lengths are in pixels; the noise of an observation counts as one pixel.

    Attributes:
        loss: robust loss on the length of each residual; huber and cauchy as in Ceres and gtsam
        loss_scale_px: residual length at which the loss turns from quadratic to robust
        max_iterations: Levenberg-Marquardt steps, rejected ones included
        relative_cost_tolerance: stop when an accepted step lowers the cost by less than this share
        settled_sigmas: stop, too, when a step moves poses and intrinsics, whichever way they are combined, by less than
            this share of their standard deviation, and only points still move; 0 for never
        initial_damping: share of the diagonal added to it at first; 1 / trust region radius in Ceres
        refine_focal: focal lengths may change
        refine_distortion: distortion coefficients may change
        refine_principal_point: principal points may change
        principal_point_sigma_px: prior around the a priori principal point; None for no prior
        distortion_sigma: prior of each coefficient around its a priori value; None for no prior
        backend: schur: our kernels; gtsam: one factor per observation, the reference
    """

    loss: Loss = "trivial"
    loss_scale_px: float = 1.0
    max_iterations: int = 50
    relative_cost_tolerance: float = 1e-6
    settled_sigmas: float = 0.0
    initial_damping: float = 1e-4
    refine_focal: bool = True
    refine_distortion: bool = True
    refine_principal_point: bool = False
    principal_point_sigma_px: float | None = None
    distortion_sigma: float | None = None
    backend: Literal["schur", "gtsam"] = "schur"

    def __post_init__(self) -> None:
        check_options("adjust", self, _RANGES)

    @property
    def refine(self) -> tuple[bool, bool, bool]:
        """Focal lengths, distortion, principal points."""
        return self.refine_focal, self.refine_distortion, self.refine_principal_point

    def robust(self, sigma_px: float) -> AdjustOptions:
        """With a loss that lets go of what is far off the noise, unless another one was asked for."""
        if self.loss != AdjustOptions().loss:
            return self
        return replace(self, loss="cauchy", loss_scale_px=_LOSS_SIGMAS * sigma_px)


class FactorReport(Report):
    """Factors of one kind at the end of an adjustment.

    Attributes:
        kind: ``reprojection``, ``intrinsics prior``, or the name of gtsam's class.
        num_factors, num_rows: how many, and the residuals that they have together.
        cost: half the sum of their losses.
        normalized_residual: root of the mean weighted squared residual of those not rejected, in the standard
            deviations that they claim (of reprojections: in ``noise_px``): about 1 where these are right and the
            unknowns are few, far above where the factors contradict the others.
        num_rejected: those that a robust kernel gives less than a quarter of their weight.
    """

    kind: str
    num_factors: int
    num_rows: int
    cost: float
    normalized_residual: float
    num_rejected: int = 0


class AdjustReport(Report):
    """What an adjustment did.

    Attributes:
        termination: ``converged``, ``iterations`` (limit reached), ``stalled`` (no damping gives a better state),
            ``nothing`` (no unknowns or no observations), or ``unsettled``: of a closing adjustment whose rounds of
            adjusting and of choosing observations ran out before they came to rest.
        num_iterations, num_rejected: steps tried, and those of them that were refused.
        initial_cost, final_cost: half the sum of the losses, priors and extra factors included; square pixels, or of a
            graph with ``noise_px``, square standard deviations.
        num_images, num_cameras, num_points, num_observations: what took part; images and cameras only if they vary.
        num_unknowns: of the reduced system, in which most points are eliminated.
        solver: of the reduced system: ``tiles`` (ours), ``envelope`` (ours, of large ones), ``fronts`` (ours, of large
            sparse ones), ``iterative`` (of large and full ones, never made), ``gtsam`` (sparse) or ``lapack`` (dense);
            ``none`` where gtsam adjusted the plain graph, one factor per observation.
        fill: share of the pairs of unknown blocks that meet in a point or a factor.
        noise_px: standard deviation of a pixel coordinate that the factors were weighed with.
        factors: what each kind of factor came to.
        num_left_out: extra factors over images, points or cameras that had no part.
        wall_s: seconds that went by.
    """

    termination: str
    num_iterations: int = 0
    num_rejected: int = 0
    initial_cost: float = 0.0
    final_cost: float = 0.0
    num_images: int = 0
    num_cameras: int = 0
    num_points: int = 0
    num_observations: int = 0
    num_unknowns: int = 0
    solver: str = "tiles"
    fill: float = 1.0
    noise_px: float = 1.0
    factors: Sequence[FactorReport] = ()
    num_left_out: int = 0
    wall_s: float = 0.0

    def residual_text(self, factors: FactorReport) -> str:
        """Normalised residual of some factors: of reprojections in pixels, of others in their standard deviations."""
        if factors.kind == "reprojection":
            return f"{factors.normalized_residual * self.noise_px:.2f} px"
        return f"{factors.normalized_residual:.2f} sigmas"

    @property
    def text(self) -> str:
        """In a line: the size, the solver, the costs, and what each kind of factor came to."""
        solver = {"none": "gtsam, one factor per observation"}.get(self.solver, self.solver)
        parts = [
            f"{self.num_unknowns} unknowns, {self.fill:.0%} full, by {solver}",
            f"{self.num_iterations} steps, {self.termination}",
            f"cost {self.initial_cost:.6g} to {self.final_cost:.6g}",
        ]
        for f in self.factors:
            rejected = f", {f.num_rejected} rejected" if f.num_rejected else ""
            parts.append(f"{f.num_factors} {f.kind} at {self.residual_text(f)}{rejected}")
        if self.num_left_out:
            parts.append(f"{self.num_left_out} factors left out")
        return "; ".join(parts)
