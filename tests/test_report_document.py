"""Lights of the report that no stage's own test sees."""

from __future__ import annotations

from sfmapp.mapping.report import Uncertainty
from sfmapp.report.document import check_open_images


def test_images_that_are_left_open_are_named_in_an_amber_light() -> None:
    assert check_open_images([Uncertainty(), Uncertainty()]) == []
    names = ["a.jpg", "b.jpg", "c.jpg", "d.jpg"]
    (light,) = check_open_images([Uncertainty(images_left_open=names[:1]), Uncertainty(images_left_open=names[1:])])
    assert light.light == "amber"
    assert light.value == "a.jpg, b.jpg, c.jpg and 1 more"
