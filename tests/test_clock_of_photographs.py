"""The offset between the clock of photographs and that of a track, by the way of the cameras."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("surveys", reason="benchmarks/ is not part of an installed package")

import surveys
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.georeference.clock import find_offset
from sfmapp.georeference.options import GpsOptions
from sfmapp.georeference.sources import places_along, with_positions
from sfmapp.georeference.stage import georeference_models


def bent_way(seconds: np.ndarray) -> np.ndarray:
    """(n, 3) metres of somebody who walks a loop at a changing pace."""
    along = 0.02 * seconds + 0.3 * np.sin(0.05 * seconds)
    return np.column_stack([40 * np.sin(along), 30 * np.sin(2 * along), 1.5 + 0.5 * np.sin(along)])


def straight_way(seconds: np.ndarray) -> np.ndarray:
    return np.column_stack([1.3 * seconds, 0.4 * seconds, 0.0 * seconds])


def tracked(way: object, offset_s: float, seed: int, sigma_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A track of a fix a second with noise, times of 40 photographs by a clock that is slow by an offset, and their
    centres in a model."""
    rng = np.random.default_rng(seed)
    clock = np.arange(0.0, 400.0)
    track = np.column_stack([clock, way(clock) + sigma_m * rng.normal(size=(400, 3)) * [1, 1, 2]])  # type: ignore[operator]
    taken = np.sort(rng.uniform(120.0, 280.0, 40))
    turn = rigid3.exp_so3(rng.normal(size=3))
    centers = 0.1 * (way(taken) + 0.02 * rng.normal(size=(40, 3))) @ turn.T  # type: ignore[operator]
    return track, taken - offset_s, centers


@pytest.mark.parametrize("offset_s", [0.0, -37.0])
def test_a_bent_way_tells_the_offset_within_its_sigma(offset_s: float) -> None:
    normalized = []
    for seed in range(8):
        found = find_offset(*tracked(bent_way, offset_s, seed, 1.0))
        assert found.offset_s is not None
        assert found.sigma_s is not None
        assert found.is_applied == (abs(found.offset_s) > 3 * found.sigma_s)
        assert found.is_applied == (offset_s != 0.0)
        assert found.sigma_s < 0.6
        normalized.append((found.offset_s - offset_s) / found.sigma_s)
    # of eight: chi square at 0.001 and 0.999
    assert 0.86 < float(np.sum(np.square(normalized))) < 26.1


def test_a_straight_way_tells_nothing() -> None:
    for seed in range(3):
        found = find_offset(*tracked(straight_way, 5.0, seed, 1.0))
        assert not found.is_applied
        assert found.reason


def test_places_along_a_track() -> None:
    track = np.array([[0.0, 1.0, 2.0, 3.0], [10.0, 2.0, 2.0, np.nan], [100.0, 3.0, 2.0, 3.0]])
    found = places_along(track, np.array([-1.0, 0.0, 5.0, 10.0, 50.0, 100.0, 101.0, np.nan]))
    np.testing.assert_allclose(found[:, 0], [np.nan, 1.0, 1.5, 2.0, np.nan, 3.0, np.nan, np.nan])
    assert np.isnan(found[2, 2])


def test_photographs_are_moved_along_their_track(tmp_path: Path) -> None:
    """A walk along a bent street, faster and slower, by a clock that is nine seconds slow."""
    survey = surveys.make_survey("walk", 5)
    centers, rng = survey.truth.centers, np.random.default_rng(5)
    taken = np.cumsum(4.0 + 2.0 * np.sin(0.7 * np.arange(len(centers))))
    seconds = np.arange(-60.0, taken[-1] + 60.0)
    path = np.column_stack([np.interp(seconds, taken, axis) for axis in centers.T])
    lines = ["time,latitude,longitude,height"]
    for second, place in zip(seconds, path + 0.5 * rng.normal(size=path.shape) * [1, 1, 2], strict=True):
        at = surveys.FRAME.geodetic_from_enu(place)
        lines.append(f"{1.7e9 + second},{at[0]:.9f},{at[1]:.9f},{at[2]:.3f}")
    (tmp_path / "track.csv").write_text("\n".join(lines) + "\n")
    image_set, _, _ = surveys.positions(survey, "phone", 5)
    images = tuple(
        replace(r, position=None, timestamp=1.7e9 + t - 9.0) for r, t in zip(image_set.images, taken, strict=True)
    )
    assert datetime.fromtimestamp(images[0].timestamp, UTC).year == 2023
    options = GpsOptions(source=str(tmp_path / "track.csv"))
    image_set = with_positions(replace(image_set, images=images), options)
    with ThreadPoolExecutor(1) as pool:
        mapper = surveys.mapper_of(survey, pool)
        mapper.polish()
        placed = georeference_models([mapper], image_set, options, Events())
    clock = placed.report.clock
    assert clock is not None
    assert clock.is_applied
    assert clock.offset_s is not None
    assert clock.sigma_s is not None
    assert abs(clock.offset_s - 9.0) < 4 * clock.sigma_s < 2.0
    assert placed.georeference is not None
    now = placed.georeference.frame.geodetic_from_enu(mapper.reconstruction.centers)
    off = surveys.FRAME.enu_from_geodetic(now) - centers
    assert np.linalg.norm(off, axis=1).max() < 2.0
