"""Reports as objects, as mappings and as JSON, and back; what does not fit is refused by name."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import FrozenInstanceError, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from sfmapp.reporting import Plain, Report, Usage, document_text, from_plain, plain, to_json


class Row(Report):
    count: int
    evidence: Mapping[str, Plain]


class Other(Report):
    reason: str


class Whole(Report):
    length: float | None
    rows: Sequence[Row]
    by_name: Mapping[str, Row]
    pair: tuple[int, str]
    light: Literal["green", "red"]
    end: Row | Other | None = None
    note: str | None = None


def whole() -> Whole:
    row = Row(count=1, evidence={"nested": [1, None, {"z": 2.5}]})
    return Whole(length=None, rows=[row], by_name={"a": row}, pair=(1, "b"), light="green")


def test_a_report_reads_as_a_mapping_and_cannot_be_changed() -> None:
    report = whole()
    assert report["rows"][0]["count"] == report.rows[0].count == 1
    assert list(report) == ["length", "rows", "by_name", "pair", "light"]
    assert report == dict(report)
    assert report.get("note", "none") == "none"
    assert dict(replace(report, note="x"))["note"] == "x"
    with pytest.raises(KeyError):
        report["note"]
    with pytest.raises(KeyError):
        report["get"]
    with pytest.raises(FrozenInstanceError):
        report.length = 1.0  # type: ignore[misc]
    with pytest.raises(FrozenInstanceError):
        del report.light
    assert repr(Other(reason="why")) == "Other(reason='why')"


class Placed(Report, kw_only=False):
    where: str
    tags: list[str] = field(default_factory=list)


def test_a_report_is_made_of_all_its_fields_and_of_no_others() -> None:
    assert Placed("here") == Placed(where="here") == {"where": "here", "tags": []}
    assert Placed("here").tags is not Placed("here").tags
    assert pickle.loads(pickle.dumps(Placed("here", ["x"]))) == Placed("here", ["x"])
    wrong: list[tuple[str, Callable[[], object]]] = [
        ("by name", lambda: Row(1, {})),  # type: ignore[misc]
        ("'evidence' is missing", lambda: Row(count=1)),  # type: ignore[call-arg]
        ("'nought' is not one", lambda: Row(count=1, evidence={}, nought=0)),  # type: ignore[call-arg]
        ("each field once", lambda: Placed("here", where="there")),  # type: ignore[misc]
        ("each field once", lambda: Placed("here", [], "more")),  # type: ignore[call-arg]
    ]
    for message, make in wrong:
        with pytest.raises(TypeError, match=message):
            make()


@pytest.mark.parametrize("end", [None, Row(count=2, evidence={}), Other(reason="why")])
def test_json_there_and_back_is_the_same(end: Row | Other | None) -> None:
    report = replace(whole(), end=end, length=2.0)
    for text in (to_json(report), to_json(report, indent=1), document_text(report)):
        again = from_plain(Whole, json.loads(text))
        assert again == report
        assert type(again.end) is type(end)
    assert "note" not in plain(report)
    assert plain(whole())["length"] is None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"length": "long"}, "Whole.length: expected int or float, found str"),
        ({"rows": {}}, "Whole.rows: expected list, found dict"),
        ({"rows": [{"count": 1.5, "evidence": {}}]}, r"Whole.rows\[0\].count: expected int, found float"),
        ({"rows": [{"count": True, "evidence": {}}]}, "expected int, found bool"),
        ({"pair": [1]}, "expected 2 entries, found 1"),
        ({"light": "blue"}, "expected one of"),
        ({"end": {"reason": 1}}, "Whole.end.reason: expected str"),
        ({"unknown": 1}, "'unknown' is not one of its fields"),
    ],
)
def test_what_does_not_fit_is_named(change: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        from_plain(Whole, {**plain(whole()), **change})
    without = {name: value for name, value in plain(whole()).items() if name != "light"}
    with pytest.raises(ValueError, match="'light' is missing"):
        from_plain(Whole, without)
    with pytest.raises(ValueError, match="expected dict, found list"):
        from_plain(Whole, [])


def test_numbers_of_numpy_paths_and_sets_are_plain() -> None:
    values = {"a": np.float32(0.5), "b": np.arange(2), "c": Path("x"), "d": {2, 1}, "e": Usage(wall_s=1.0, cpu_s=2.0)}
    expected = {"a": 0.5, "b": [0, 1], "c": "x", "d": [1, 2], "e": {"wall_s": 1.0, "cpu_s": 2.0}}
    assert json.loads(to_json(values)) == expected
