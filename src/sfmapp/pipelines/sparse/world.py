"""Finished models into the world: by positions of photographs, and by ground control, read before the work begins."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from sfmapp.errors import UsageError
from sfmapp.formats.control_points import ControlPoints, read_control_points
from sfmapp.pipelines.sparse.keys import StageKeys, stage_keys
from sfmapp.pipelines.sparse.run import Run

if TYPE_CHECKING:
    from sfmapp.georeference.poses.report import PosesReport
    from sfmapp.georeference.poses.stage import PoseFile
    from sfmapp.images.image_set import ImageSet
    from sfmapp.mapping.known_poses import HeldPoses
    from sfmapp.mapping.mapper import Mapper


def read_world(run: Run, image_set: ImageSet) -> StageKeys:
    """Read what places the run's photographs in the world, and return the keys of its stages, which depend on it.

    Raises:
        InputError, MissingPackageError, UsageError: as of :func:`read_control` and :func:`read_known_poses`, and where
            a known length is not what it has to be.
    """
    run.control = read_control(run, image_set)
    run.poses = read_known_poses(run, image_set)
    if run.options.units.known is not None:
        from sfmapp.pipelines.sparse.known_lengths import parse_known_lengths

        run.known = parse_known_lengths(run.options.units.known, image_set.names)
    return stage_keys(run.options, image_set, run.control, run.poses)


def read_control(run: Run, image_set: ImageSet) -> ControlPoints | None:
    """The control points that a run was given, checked against its photographs and for a system that there is.

    Raises:
        InputError: the file is not what it has to be; file, line, what was expected and what was found.
        MissingPackageError: its coordinate system needs pyproj, which is not installed.
    """
    options = run.options.control
    if options.file is None:
        return None
    from sfmapp.georeference.control.points import survey_in_frame

    sizes = {record.name: (record.width, record.height) for record in image_set.images}
    sigma_m = (options.sigma_m, options.sigma_m, options.sigma_up_m)
    control = read_control_points(options.file, sizes, sigma_m=sigma_m, sigma_px=options.sigma_px)
    survey_in_frame(control)  # refuses what is no place on Earth before an hour is spent
    return control


def has_factors(run: Run, image_set: ImageSet) -> bool:
    """Whether models are adjusted to more than photographs: to positions, known poses or control points."""
    has_positions = any(record.position is not None for record in image_set.images)
    return has_positions or run.poses is not None or run.control is not None


def read_known_poses(run: Run, image_set: ImageSet) -> PoseFile | None:
    """The poses that a run was given, by photograph.

    Raises:
        InputError: the file is not what it has to be, or holds poses of other photographs.
        UsageError: something else places the models too, or there is nothing to be held.
    """
    options = run.options
    if options.poses.file is None:
        if options.poses.fixed:
            raise UsageError("--fix-poses needs known poses, found none", "give them: --pose-priors FILE")
        return None
    others = {"--gcp": options.control.file is not None, "--scale": bool(options.units.known),
              "--up": options.units.up != "none", "--gps": options.gps.source not in ("exif", "none")}  # fmt: skip
    beside = [name for name, is_given in others.items() if is_given]
    if beside:
        raise UsageError(
            f"--pose-priors and {beside[0]} both set the frame of the models",
            "give one of them; known poses bring their frame",
        )
    from sfmapp.georeference.poses.stage import read_poses

    return read_poses(options.poses, image_set.names)


def held_poses(run: Run, poses: PoseFile, image_set: ImageSet) -> HeldPoses:
    """Known poses that stay, and what judges them in the end."""
    from sfmapp.georeference.poses.held import judge_held_poses
    from sfmapp.mapping.known_poses import HeldPoses

    def judge(mapper: Mapper) -> None:
        report = judge_held_poses(mapper, poses, run.events)
        run.stages = replace(run.stages, poses=_beside_positions(run, report, [mapper], image_set))

    return HeldPoses(poses.cam_from_world, judge)


def _beside_positions(run: Run, report: PosesReport, mappers: Sequence[Mapper], image_set: ImageSet) -> PosesReport:
    """The report on known poses, with what positions of the photographs say beside these."""
    from sfmapp.georeference.poses.positions import with_positions

    return with_positions(report, [mapper.reconstruction for mapper in mappers], image_set, run.options.gps, run.events)


def closing(run: Run, image_set: ImageSet) -> Callable[[list[Mapper]], None] | None:
    """What is to be done with finished models; None where nothing is known of where they lie."""
    poses = run.poses
    if poses is not None:
        from sfmapp.georeference.poses.stage import pose_models

        def bring_to_poses(mappers: list[Mapper]) -> None:
            report = pose_models(mappers, poses, run.events)
            run.stages = replace(run.stages, poses=_beside_positions(run, report, mappers, image_set))

        return bring_to_poses
    has_positions = any(record.position is not None for record in image_set.images)
    units = run.options.units
    if run.control is None and not has_positions and not run.known and units.up == "none":
        return None

    def bring_into_world(mappers: list[Mapper]) -> None:
        if has_positions:
            from sfmapp.georeference.stage import georeference_models

            placed = georeference_models(mappers, image_set, run.options.gps, run.events)
            run.georeference = placed.georeference
            run.stages = replace(run.stages, georeference=placed.report)
        if run.control is not None:
            from sfmapp.georeference.control.stage import control_models, positions_after

            controlled = control_models(
                mappers, run.control, run.georeference, run.stages.georeference, run.events
            )  # fmt: skip
            run.georeference = controlled.georeference
            positions = run.stages.georeference
            if positions is not None and controlled.georeference is not None:
                positions = positions_after(positions, controlled.report, mappers)
            run.stages = replace(run.stages, control=controlled.report, georeference=positions)
        if run.known or units.up != "none":
            from sfmapp.pipelines.sparse.units import give_units

            metric = {place.model for place in run.georeference.models} if run.georeference is not None else set()
            if run.stages.control is not None:
                metric |= {row.model for row in run.stages.control.models if not row.reason}
            found = give_units(
                mappers, image_set, run.known, units.up, metric, threads=run.threads, events=run.events
            )  # fmt: skip
            run.stages = replace(run.stages, units=found)

    return bring_into_world
