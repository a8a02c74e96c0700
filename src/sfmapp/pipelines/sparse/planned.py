"""Between a plan and the run that follows it: by photographs and options they know each other."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sfmapp.pipelines.sparse.keys import StageKeys
from sfmapp.report.plan import PlanCheck, PlanReport
from sfmapp.workspace.keys import stage_key
from sfmapp.workspace.options import Options, options_to_dict
from sfmapp.workspace.user_cache import recall, remember

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sfmapp.report.model import Stages
    from sfmapp.reporting import Usage

_KIND = "plans"


def plan_key(keys: StageKeys, options: Options) -> str:
    """Key of a plan: of photographs, of the options that decide what a run takes, and of the source code."""
    return stage_key(
        (), options.mapping, keys.pairs, keys.matching, options_to_dict(options.adjust), options.num_workers
    )


def remember_plan(plan: PlanReport) -> None:
    """Keep a plan for the run that follows."""
    remember(_KIND, plan.key, plan)


def held_against_plan(
    keys: StageKeys, options: Options, stages: Stages, usage: Mapping[str, Usage], run: Usage
) -> PlanCheck | None:
    """What a run took beside what was planned; None where nothing was, or where it did not do all of it by itself: it
    went on with what was there, compiled kernels, or had workers elsewhere."""
    if options.cluster is not None or stages.features is None or stages.matching is None or stages.mapping is None:
        return None
    is_whole = not stages.features.num_known and not stages.matching.num_resumed_pairs
    kernels = usage.get("kernels")
    if not is_whole or (kernels is not None and kernels.num_compiled):
        return None
    plan = recall(_KIND, plan_key(keys, options), PlanReport)
    return None if plan is None else PlanCheck.of(plan, usage, run)
