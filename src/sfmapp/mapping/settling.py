"""When a closing adjustment has come to rest: its rounds of adjusting and of choosing observations.

Where the loss bends is measured once, of the residuals that squares leave, and then held, as in MM-estimation (Yohai
1987): measured anew in every round it shrinks with every round on tracks that leave few degrees of freedom, and at last
believes what happens to agree (Gaussian noise of half a pixel on tracks of four: 12 % of right observations lost).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.options import AdjustOptions, AdjustReport
from sfmapp.events import Events

Mask = NDArray[np.bool_]

# Steps of a round, and of one that begins with observations at rest; and the most rounds. Measured on six sets: of so
# few steps each, rounds take half to all of the steps that rounds to the end take.
_FEW_STEPS, _MANY_STEPS, _MAX_ROUNDS = 8, 100, 20
# The shape has settled when a step moves no combination of poses and intrinsics by more than this share of its standard
# deviation. Steps of robust losses shrink by a factor of 0.7 to 0.9 each, so that up to ten times as much is left: with
# 0.05 one solver and another came to minima 0.3 deviations apart, with 0.02 to the same.
_SETTLED_SIGMAS = 0.02
# Observations have settled when no larger share of them changes sides; and in a round to the end, which lets go of
# somewhat more than the few steps before it.
_MAX_CHANGED, _SLACK = 1e-3, 3.0


def round_options(options: AdjustOptions, num_steps: int) -> AdjustOptions:
    """The options of a round."""
    return replace(options, max_iterations=num_steps, settled_sigmas=_SETTLED_SIGMAS)


@dataclass(frozen=True)
class Round:
    """What a round has brought.

    Attributes:
        report: of its adjustment.
        before, after: (O,) bool observations that hold, before and after it.
    """

    report: AdjustReport
    before: Mask
    after: Mask

    @property
    def num_changed(self) -> int:
        """Observations that changed sides."""
        return int((self.before != self.after).sum())

    def is_quiet(self, slack: float = 1.0) -> bool:
        """Whether observations have settled, but for so many times what is allowed."""
        return self.num_changed <= slack * _MAX_CHANGED * int(self.before.sum())


def adjust_until_settled(adjust: Callable[[int], Round], stage: str, events: Events) -> AdjustReport:
    """Make rounds, each of so many steps at most, until one has settled; the report of the last.

    Where none does, a warning and the report, which is ``unsettled``, say so.
    """
    num_steps = _FEW_STEPS
    for _ in range(_MAX_ROUNDS):
        made = adjust(num_steps)
        slack = _SLACK if num_steps == _MANY_STEPS else 1.0
        if made.is_quiet(slack) and made.report.termination != "iterations":
            return made.report
        num_steps = _MANY_STEPS if made.is_quiet() else _FEW_STEPS
    events.warned(
        stage,
        f"the closing adjustment did not settle in {_MAX_ROUNDS} rounds: the model still changes, by more than its "
        "deviations say; a known calibration, or photographs from more sides, would hold it",
    )
    return replace(made.report, termination="unsettled")
