"""``sfmapp plan``: what a reconstruction will take, before it begins."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import TYPE_CHECKING

from sfmapp.cli.common import add_output_flags, listening, print_json
from sfmapp.cli.reconstruct import add_option_flags, effective_options
from sfmapp.kernel_cache import load_numba_sparingly

if TYPE_CHECKING:
    from sfmapp.report.plan import PlanReport, StagePlan

EXAMPLES = """\
examples:
  sfmapp plan photos/
  sfmapp plan photos/ --preset quality --threads 4
  sfmapp plan photos/ --mesh

Takes the options of reconstruct. Photographs are looked at in small, a few are worked on as the run will do it, and the
machine is measured once by the bundled sample; nothing is written but what is remembered in the user's cache. The run
that follows with the same photographs and options compares itself with its plan, in its report."""


def add_commands(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "plan", help="what a reconstruction will take, and what will go wrong, before it begins",
        description="Tell what sfmapp reconstruct will take of time, memory and disk, and what will probably go wrong.",
        epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("images", metavar="IMAGES", help="a folder, a quoted glob, or a .txt list of files")
    parser.add_argument("--dense", action="store_true", help="tell of dense patches as well")
    parser.add_argument("--mesh", action="store_true", help="tell of dense patches and their mesh as well")
    add_option_flags(parser)
    add_output_flags(parser)
    parser.set_defaults(run=_plan)


def _plan(args: argparse.Namespace) -> int:
    options = effective_options(args)
    load_numba_sparingly()
    from sfmapp.pipelines.planning.plan import plan
    from sfmapp.workspace.usage import Stopwatch

    watch = Stopwatch(whole_process=True)
    with listening(args) as events:
        report = plan(args.images, options, dense=args.dense, mesh=args.mesh, events=events, watch=watch)
    if args.json:
        print_json({"exit_code": 0, **report})
    elif not args.quiet:
        print("\n".join(_lines(report)))
    return 0


def _lines(plan: PlanReport) -> Iterator[str]:
    """A plan in words."""
    skipped = f" ({plan.num_skipped} files cannot be used)" if plan.num_skipped else ""
    yield f"{plan.num_images} photographs of {plan.megapixels:.0f} megapixels in all{skipped}"
    for camera in sorted(plan.cameras, key=lambda camera: -camera.num_images)[:_CAMERAS]:
        whose = f"{camera.name}, " if camera.name else ""
        focal = "focal length unknown" if camera.focal_source == "default" else f"f {camera.focal_px:.0f} px"
        yield f"  {camera.num_images} by {whose}{camera.width}x{camera.height}, {camera.model}, {focal}"
    if len(plan.cameras) > _CAMERAS:
        yield f"  and {len(plan.cameras) - _CAMERAS} cameras more"
    sizes = [size for size in plan.groups if size > 1]
    alone = sum(size == 1 for size in plan.groups)
    if len(sizes) == 1 and not alone:
        yield "  all of them are linked by what they show"
    else:
        shown = ", ".join(map(str, sizes[:_GROUPS])) + (", ..." if len(sizes) > _GROUPS else "")
        text = f"in groups of {shown} that show the same" if sizes else "none linked with another"
        yield f"  {text}" + (f", {alone} alone" if sizes and alone else "")
    yield (
        f"{plan.num_pairs} pairs ({plan.pairs_reason}), {plan.num_overlapping.text('overlap')}; "
        f"{plan.num_features.text('features')}, {plan.num_matches.text('matches')}"
    )
    yield f"{'':<12}{'CPU s':>16}{'s':>16}{'MB':>16}"
    for stage in [*plan.stages, plan.whole]:
        yield _row(stage)
    if plan.surface:
        yield f"and then, roughly, {plan.surface_disk_mb.text('MB')} of disk and"
        for stage in plan.surface:
            yield _row(stage)
    machine = plan.machine
    yield (
        f"on {plan.threads} threads of {machine.processor}, with nothing else at work; most memory in "
        f"{plan.peak_stage}, of {machine.memory_mb / 1000:.1f} GB; {plan.disk_mb.text('MB')} of disk"
    )
    for doubt in plan.doubts:
        yield f"{doubt.weight}: {doubt.message}"
        yield f"  {doubt.remedy}"
    if not any(doubt.weight == "warning" for doubt in plan.doubts):
        yield "nothing was found that will go wrong"
    yield f"planned in {plan.took.wall_s:.1f} s, {plan.took.cpu_s:.1f} CPU s"


# that are told one by one
_CAMERAS, _GROUPS = 4, 12


def _row(stage: StagePlan) -> str:
    """A line of the table."""
    cells = [_cell(each.low, each.high) for each in (stage.cpu_s, stage.wall_s, stage.memory_mb)]
    return f"{stage.stage:<12}" + "".join(f"{cell:>16}" for cell in cells)


def _cell(low: float, high: float) -> str:
    """Both ends of an interval, to two digits below 100."""
    ends = [f"{value:.0f}" if value >= 10 else f"{value:.1f}" for value in (low, high)]
    return ends[0] if ends[0] == ends[1] else f"{ends[0]} to {ends[1]}"
