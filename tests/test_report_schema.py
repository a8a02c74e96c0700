"""The committed JSON schemas are those of the reports, and refuse what is none of theirs.

That real reports of each command obey them is tested where these are made.
"""

from __future__ import annotations

import jsonschema
import pytest

from schemas import FOLDER, check_schema
from sfmapp.report.model import RunUsage, UndistortedCamera, UndistortReport
from sfmapp.report.schema import KINDS, schema_of, schema_text
from sfmapp.reporting import NamedReason, plain


def undistorted() -> UndistortReport:
    return UndistortReport(
        num_images=1, num_faces=0, num_copied=0, num_masks=0, num_points=5, num_observations=9, num_dropped=1,
        cameras=[UndistortedCamera(width=4, height=3, params=[1.0, 1.0, 2.0, 1.5])],
        missing=[NamedReason(name="a.jpg", reason="gone")], run=RunUsage(wall_s=1.0, cpu_s=2.0),
    )  # fmt: skip


@pytest.mark.parametrize("name", KINDS)
def test_the_committed_schema_is_that_of_the_report(name: str) -> None:
    jsonschema.Draft202012Validator.check_schema(schema_of(KINDS[name]))
    committed = (FOLDER / f"{name}.json").read_text(encoding="utf-8")
    assert committed == schema_text(KINDS[name]), "run: python -m sfmapp.report.schema docs/reference/schemas"


def test_no_schema_is_left_over() -> None:
    assert sorted(path.stem for path in FOLDER.iterdir()) == sorted(KINDS)


def test_a_report_obeys_its_schema_and_others_do_not() -> None:
    document = plain(undistorted())
    check_schema("undistort", document)
    for change in ({"num_images": "1"}, {"run": {"wall_s": 1.0}}, {"unknown": 1}, {"missing": [{"name": "a"}]}):
        with pytest.raises(jsonschema.ValidationError):
            check_schema("undistort", {**document, **change})
    with pytest.raises(jsonschema.ValidationError):
        check_schema("undistort", {**document, "run": {**document["run"], "peak_memory_mb": None}})
