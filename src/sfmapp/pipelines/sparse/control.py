"""Ground control of a reconstruction: read before the work begins, and brought in when models are finished."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from sfmapp.formats.control_points import ControlPoints, read_control_points
from sfmapp.pipelines.sparse.run import Run

if TYPE_CHECKING:
    from sfmapp.images.image_set import ImageSet
    from sfmapp.mapping.mapper import Mapper


def read_control(run: Run, image_set: ImageSet) -> ControlPoints | None:
    """The control points that a run was given, checked against its photographs and for a system that there is.

    Raises:
        InputError: the file is not what it has to be; file, line, what was expected and what was found.
        MissingPackageError: its coordinate system needs pyproj, which is not installed.
    """
    options = run.options.control
    if options.file is None:
        return None
    from sfmapp.georeference.control import survey_in_frame

    sizes = {record.name: (record.width, record.height) for record in image_set.images}
    sigma_m = (options.sigma_m, options.sigma_m, options.sigma_up_m)
    control = read_control_points(options.file, sizes, sigma_m=sigma_m, sigma_px=options.sigma_px)
    survey_in_frame(control)  # refuses what is no place on Earth before an hour is spent
    return control


def bring_control(run: Run, before: Callable[[list[Mapper]], None] | None) -> Callable[[list[Mapper]], None] | None:
    """What is to be done with finished models: something else, and then control; None where there is nothing to do."""
    if run.control is None:
        return before

    def closing(mappers: list[Mapper]) -> None:
        from sfmapp.georeference.control_stage import control_models

        assert run.control is not None
        if before is not None:
            before(mappers)
        found = control_models(mappers, run.control, run.georeference, run.events)
        run.georeference = found.georeference
        run.stages = replace(run.stages, control=found.report)

    return closing
