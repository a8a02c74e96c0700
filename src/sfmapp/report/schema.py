"""JSON schemas of the reports, made from the dataclasses that they are.

``python -m sfmapp.report.schema docs/reference/schemas`` writes them anew; a test says when that is due.
"""

from __future__ import annotations

import json
import sys
import types
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Union

from sfmapp.calibration.file import CalibrationDocument
from sfmapp.calibration.point_reports import LocationReport, MeasureReport, TargetReport, TargetsReport
from sfmapp.georeference.world_frame import Georeference
from sfmapp.planes.report import RectifyReport, WarpReport
from sfmapp.report.carve_document import CarveReport
from sfmapp.report.evaluation import EvaluationReport
from sfmapp.report.located_html import LocatedReport
from sfmapp.report.masks_html import MaskFilesReport
from sfmapp.report.model import (
    CalibrateReport,
    CalibrateRigReport,
    DenseRunReport,
    ExportReport,
    OdometryRunReport,
    ReconstructionReport,
    RefineReport,
    UndistortReport,
)
from sfmapp.report.pair_html import PairReport
from sfmapp.report.panorama_html import PanoramaReport
from sfmapp.report.plan import PlanReport
from sfmapp.report.stereo_document import StereoReport
from sfmapp.report.sweep_document import SweepReport
from sfmapp.report.transfer_html import TransferRunReport
from sfmapp.report.uncalibrated_html import UncalibratedReport
from sfmapp.report.validation import CloudValidation, Validation
from sfmapp.reporting import Report, field_types
from sfmapp.stereo.design import DesignReport

# by the name of the file: report.json of reconstruct, of dense and mesh on a foreign model, of odometry, refine,
# calibrate, locate (of points, in a model), pair, panorama, warp, rectify, stereo, carve, masks and sweep;
# calibration.json; validation/report.json and validation/cloud.json; what plan, evaluate, undistort, export, measure
# and stereo-design print with --json; and georeference.json
KINDS: Mapping[str, type[Report]] = {
    "reconstruct": ReconstructionReport,
    "plan": PlanReport,
    "dense": DenseRunReport,
    "odometry": OdometryRunReport,
    "refine": RefineReport,
    "validate": Validation,
    "validate-cloud": CloudValidation,
    "evaluate": EvaluationReport,
    "undistort": UndistortReport,
    "calibrate-board": CalibrateReport,
    "calibrate-rig": CalibrateRigReport,
    "calibration": CalibrationDocument,
    "export": ExportReport,
    "georeference": Georeference,
    "calibrate-target": TargetReport,
    "calibrate-targets": TargetsReport,
    "locate": LocationReport,
    "locate-model": LocatedReport,
    "measure": MeasureReport,
    "pair": PairReport,
    "panorama": PanoramaReport,
    "transfer": TransferRunReport,
    "uncalibrated": UncalibratedReport,
    "stereo-design": DesignReport,
    "warp": WarpReport,
    "rectify": RectifyReport,
    "stereo": StereoReport,
    "carve": CarveReport,
    "masks": MaskFilesReport,
    "sweep": SweepReport,
}
_SIMPLE = {bool: "boolean", int: "integer", float: "number", str: "string", type(None): "null"}


def schema_of(kind: type[Report]) -> dict[str, Any]:
    """The JSON schema (draft 2020-12) of a report; no other fields are allowed."""
    parts: dict[str, Any] = {}
    _add(kind, parts)
    top = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": kind.__name__}
    return top | {"$ref": f"#/$defs/{kind.__name__}", "$defs": dict(sorted(parts.items()))}


def schema_text(kind: type[Report]) -> str:
    """The schema as it stands in its file."""
    return json.dumps(schema_of(kind), indent=1) + "\n"


def _add(kind: type[Report], parts: dict[str, Any]) -> None:
    if kind.__name__ in parts:
        return
    parts[kind.__name__] = {}  # it may hold itself
    fields = field_types(kind)
    parts[kind.__name__] = {
        "type": "object",
        "description": (kind.__doc__ or "").strip().partition("\n")[0],
        "properties": {name: _schema(field, parts, is_optional) for name, (field, is_optional) in fields.items()},
        "required": [name for name, (_, is_optional) in fields.items() if not is_optional],
        "additionalProperties": False,
    }


def _schema(kind: Any, parts: dict[str, Any], is_optional: bool = False) -> dict[str, Any]:
    """Of the type of a field; one that is optional is left out where it is None, and is never null."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (Union, types.UnionType):
        if {bool, int, float, str} <= set(arguments):  # anything that JSON holds
            return {}
        kinds = [other for other in arguments if not (is_optional and other is type(None))]
        return _schema(kinds[0], parts) if len(kinds) == 1 else {"anyOf": [_schema(other, parts) for other in kinds]}
    if origin is typing.Literal:
        return {"enum": list(arguments)}
    if origin is tuple and arguments[-1] is not ...:
        items = [_schema(other, parts) for other in arguments]
        return {"type": "array", "prefixItems": items, "minItems": len(items), "maxItems": len(items)}
    if origin in (list, tuple, Sequence):
        return {"type": "array", "items": _schema(arguments[0], parts)}
    if origin in (dict, Mapping):
        return {"type": "object", "additionalProperties": _schema(arguments[1], parts)}
    if isinstance(kind, type) and issubclass(kind, Report):
        _add(kind, parts)
        return {"$ref": f"#/$defs/{kind.__name__}"}
    return {"type": _SIMPLE[kind]}


def write_schemas(folder: Path) -> None:
    """Write the schema of every kind of report into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, kind in KINDS.items():
        (folder / f"{name}.json").write_text(schema_text(kind), encoding="utf-8")


if __name__ == "__main__":
    write_schemas(Path(sys.argv[1]))
