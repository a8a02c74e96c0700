"""Where a camera is in a known map: all places that fit, until the landmarks have refuted all but one.

Places come from recognition and PnP, and from what is known to look alike in the map; each is a set of particles that
moves as the tracker says, and is weighed by landmarks and their reprojections. Beside them stands that the camera is
not in the map at all. A place is believed when all else together is less likely than :data:`MAX_DOUBT`, and when
every other place that the images support has been contradicted by landmarks that are missing there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import pixels_to_normalized
from sfmapp.geometry import rigid3, similarity
from sfmapp.odometry.belief.particles import MIN_PARTICLES, Particles, drawn
from sfmapp.odometry.belief.scene import KnownScene
from sfmapp.odometry.loops.detection import LoopOptions, initial_similarity, seen_in
from sfmapp.odometry.loops.evidence import MAX_DOUBT, NOT_IN_MAP, Score, Tally, log_prior
from sfmapp.odometry.loops.place_recognition import Bytes, Candidate, PlaceIndex, View
from sfmapp.odometry.loops.relocalize import (
    Located,
    RelocalizeOptions,
    agreeing_at,
    hold_near,
    is_convincing,
    is_elsewhere,
    locate,
    position_of,
    seen_as_before,
)
from sfmapp.odometry.map.keyframe_map import KeyframeMap
from sfmapp.odometry.report import BeliefReport
from sfmapp.odometry.snapshot import BeliefState

Array = NDArray[np.float64]

# Looks that are kept, to judge places by them that are thought of later.
_NUM_LOOKS = 12
# Most places that are looked at, and the log likelihood ratio below which a place is no longer looked at.
_MAX_MODES, _HOPELESS = 24, 20.0
# Most landmarks that one look asks for, of all that are expected.
_MAX_EXPECTED = 250
# Share of the weight of particles that a new measurement brings into a set (Thrun, Fox, Burgard and Dellaert, "Robust
# Monte Carlo localization for mobile robots", 2001: the mixture proposal).
_RESEEDED = 0.25
# Standard deviation of a scale that is a ratio of depths, of its logarithm.
_SCALE_SIGMA = 0.02


@dataclass(frozen=True)
class OwnFrame:
    """A keyframe of the map that the camera makes by itself.

    Attributes:
        map_idx: number of that map. keyframes: it. position: of the keyframe.
        covariance: (6, 6) of its pose given the map; not finite where unknown.
    """

    map_idx: int
    keyframes: KeyframeMap
    position: int
    covariance: Array

    @property
    def pose(self) -> Array:
        """(7,) cam_from_world."""
        return self.keyframes.keyframes[self.position].rig_from_world


@dataclass(frozen=True)
class _Look:
    pose: Array
    view: View
    roll: float


@dataclass
class Mode:
    """A place that the camera may be at.

    Attributes:
        particles: about its newest pose. known_from_own: (8,) similarity from the own map.
        tally: what was found of its landmarks. score: what that says.
        located: by the newest image; None where it is not held there.
        place: frame of the known keyframe that it is nearest to.
        probability: of being the right one.
    """

    particles: Particles
    known_from_own: Array
    tally: Tally = field(default_factory=Tally)
    score: Score = field(default_factory=Score)
    located: Located | None = None
    place: int = 0
    probability: float = 0.0

    @property
    def pose(self) -> Array:
        """(7,) cam_from_world in the known map."""
        return self.particles.mean()[0]


class PlaceBelief:
    """Of one camera in one known map. What is found depends on the order of the calls alone.

    Args:
        map_idx: number of the map in ``places``. pictures: of its keyframes, (H, W) uint8 by position.
        seed: of the particles.

    Attributes:
        modes: the places that it may be at. decided: the one that is believed, None while that is open.
        num_looks: images that were held against the map.
    """

    def __init__(
        self, map_idx: int, keyframes: KeyframeMap, places: PlaceIndex, pictures: Mapping[int, Bytes], seed: int
    ) -> None:  # fmt: skip
        self.map_idx, self._pictures = map_idx, pictures
        self._scene = KnownScene(keyframes, places, pictures)
        self._places, self._rng = places, np.random.default_rng([seed, 0x9A27])
        self._options = RelocalizeOptions()
        self.num_looks = self._num_open = self._max_particles = 0
        self._num_looks_to_decision: int | None = None
        self.modes: list[Mode] = []
        self.decided: Mode | None = None
        self.not_in_map = NOT_IN_MAP
        self._stretch: int | None = None
        self._looks: list[_Look] = []

    def reset(self) -> None:
        """Forget where the camera may be: it was lost, or the map has changed."""
        self.modes, self.decided, self._looks, self._stretch = [], None, [], None
        self.not_in_map = NOT_IN_MAP

    def look(self, keyframes: KeyframeMap, view: View, roll: float = 0.0, own: OwnFrame | None = None) -> None:
        """Judge all places by another image.

        Args:
            keyframes: the known map. view: with corners. roll: see :func:`relocalize`.
            own: what is known of its motion: the keyframe that it is. None: nothing, it may be anywhere.
        """
        if own is None or own.map_idx != self._stretch:
            self.reset()
            self._stretch = None if own is None else own.map_idx
        if len(keyframes.keyframes) != self._scene.num_keyframes:
            self._scene = KnownScene(keyframes, self._places, self._pictures)
        pose = rigid3.IDENTITY if own is None else own.pose.copy()
        if self._looks and own is not None:
            step = rigid3.compose(pose, rigid3.inverse(self._looks[-1].pose))
            self._move(step, own.covariance)
        look = _Look(pose, view, roll)
        self._looks = [*self._looks[1 - _NUM_LOOKS :], look]
        for mode in self.modes:
            if not self._is_hopeless(mode):
                self._judge(mode, look, is_newest=True)
        held = {mode.place for mode in self.modes if mode.located is not None}
        for candidate in self._places.query_view(view, roll, (self.map_idx,)):
            if candidate.frame_idx in held:  # the image lies there already
                continue
            located = locate(keyframes, self._places, view, candidate, self._options, roll)
            if located is not None:
                self._propose(candidate, located, look, own)
        self._merge()
        self._weigh()
        best = self._best()
        if best is not None and self._is_certain(best) and self._think_of_doubles(best):
            self._merge()
            self._weigh()
            best = self._best()
        self.decided = best if best is not None and self._is_certain(best) else None
        self._count()

    def _count(self) -> None:
        self.num_looks += 1
        self._num_open += self.is_open
        self._max_particles = max(self._max_particles, sum(len(m.particles) for m in self.modes))
        if self.decided is not None and self._num_looks_to_decision is None:
            self._num_looks_to_decision = self.num_looks

    @property
    def is_open(self) -> bool:
        """The last image fitted several places, of which none is believed."""
        return self.decided is None and sum(mode.score.support > 0.0 for mode in self.modes) > 1

    def state(self) -> BeliefState:
        """What is believed now."""
        sets = [mode.particles for mode in self.modes]
        return BeliefState(
            np.concatenate([np.zeros((0, 7)), *[s.pose for s in sets]]),
            np.concatenate([np.zeros(0), *[m.probability * m.particles.weight for m in self.modes]]),
            np.repeat(np.arange(len(sets)), [len(s) for s in sets]), np.array([m.probability for m in self.modes]),
            np.array([m.pose for m in self.modes]).reshape(-1, 7), self.not_in_map,
            next((n for n, m in enumerate(self.modes) if m is self.decided), -1), self._scene.point_xyz,
        )  # fmt: skip

    def report(self) -> BeliefReport:
        """What is to be said of it in the end."""
        likely = sorted((m for m in self.modes if m.probability > MAX_DOUBT), key=lambda m: -m.probability)
        return BeliefReport(
            num_looks=self.num_looks, num_open=self._num_open, max_doubt=MAX_DOUBT, max_particles=self._max_particles,
            places=[self._scene.name_of(m.place) for m in likely], not_in_map=self.not_in_map,
            probabilities=[m.probability for m in likely], num_looks_to_decision=self._num_looks_to_decision,
        )  # fmt: skip

    # ------------------------------------------------------------------ places

    def _move(self, step: Array, covariance: Array) -> None:
        for mode in self.modes:
            depth = self._scene.depth_at(mode.place)
            # both ends are as unsure as the newest
            mode.particles = mode.particles.moved(step, 2.0 * covariance, depth, self._rng)

    def _propose(self, candidate: Candidate, located: Located, look: _Look, own: OwnFrame | None) -> None:
        """A place that recognition and PnP have found: new, or one that is there already."""
        pose, depth = located.cam_from_world, self._scene.depth_at(candidate.frame_idx)
        if any(not is_elsewhere(mode.pose, pose, depth) for mode in self.modes):
            return
        known_from_own = np.append(rigid3.inverse(pose), 1.0)
        if own is not None:
            old_idx = position_of(self._scene.keyframes, candidate.frame_idx)
            seen = seen_in(
                self._scene.keyframes, self._places, look.view, (own.position, old_idx), located, self._options
            )
            found = initial_similarity(own.keyframes, seen, LoopOptions())
            if found is None:
                return
            known_from_own = found
        self._add(known_from_own, located.covariance, candidate.frame_idx)

    def _add(self, known_from_own: Array, covariance: Array, place: int) -> None:
        """Another place, judged by all that has been seen."""
        if len(self.modes) >= _MAX_MODES:
            self._drop_worst()
        pose = similarity.transform_poses(known_from_own, self._looks[-1].pose)
        depth, log_scale = self._scene.depth_at(place), math.log(known_from_own[7])
        sigma = _SCALE_SIGMA if self._stretch is not None and not self._scene.keyframes.rig.is_stereo else 0.0
        particles = drawn(pose, covariance, log_scale, sigma, depth, MIN_PARTICLES, self._rng)
        mode = Mode(particles, known_from_own, place=place)
        self.modes.append(mode)
        self._judge(mode, self._looks[-1], is_newest=True)
        for look in self._looks[:-1]:
            self._judge(mode, look, is_newest=False)

    def _drop_worst(self) -> None:
        self.modes.remove(min(self.modes, key=lambda mode: mode.score.support + mode.score.against))

    def _merge(self) -> None:
        """Places that have come to lie on each other are one; the better supported stays."""
        kept: list[Mode] = []
        for mode in sorted(self.modes, key=lambda m: -m.score.support):
            depth = self._scene.depth_at(mode.place)
            if all(is_elsewhere(other.pose, mode.pose, depth) for other in kept):
                kept.append(mode)
        self.modes = kept

    def _think_of_doubles(self, best: Mode) -> bool:
        """Add the places that the map itself says to look like the best one; whether there are any that are new."""
        num = len(self.modes)
        for look in {id(k): k for k in (self._looks[0], self._looks[len(self._looks) // 2], self._looks[-1])}.values():
            pose = similarity.transform_poses(best.known_from_own, look.pose)
            row = self._scene.nearest(pose)
            depth = float(self._scene.depth[row])
            for motion in self._scene.look_alikes.around(int(self._scene.frame_idx[row]), depth):
                double = similarity.compose(np.append(motion, 1.0), best.known_from_own)
                there = similarity.transform_poses(double, self._looks[-1].pose)
                if all(is_elsewhere(mode.pose, there, depth) for mode in self.modes):
                    self._add(double, np.full((6, 6), np.inf), int(self._scene.frame_idx[row]))
        return len(self.modes) > num

    # ------------------------------------------------------------------ evidence

    def _judge(self, mode: Mode, look: _Look, *, is_newest: bool) -> None:
        """Look for the landmarks of a place in one image; the newest one moves its particles as well."""
        camera = self._scene.keyframes.rig.cameras[0]
        pose = mode.pose if is_newest else similarity.transform_poses(mode.known_from_own, look.pose)
        row = self._scene.nearest(pose)
        depth = float(self._scene.depth[row])
        local = self._scene.points(row, self._options.num_neighbors)
        held = hold_near(local, look.view, camera, pose, self._options)
        if held is not None and is_elsewhere(pose, held[0].cam_from_world, depth):
            held = None
        if held is not None:
            pose = held[0].cam_from_world
        expected = local.subset(seen_as_before(self._scene.keyframes, local, pose))
        expected = expected.subset(np.arange(0, len(expected.point_id), 1 + len(expected.point_id) // _MAX_EXPECTED))
        point_id, agrees = agreeing_at(expected, look.view, camera, pose)
        mode.tally.add(point_id, agrees)
        if not is_newest:
            return
        mode.located, mode.place = None, int(self._scene.frame_idx[row])
        if held is not None:
            refined, point, corner = held
            share = float(agrees.mean()) if len(agrees) else 0.0
            mode.located = Located(pose, refined.covariance, local.point_id[point], corner, 0, len(agrees), share)
            self._measure(mode, mode.located, local.xyz[point], look, depth)

    def _measure(self, mode: Mode, located: Located, xyz: Array, look: _Look, depth: float) -> None:
        """Weigh the particles of a place by reprojections of the landmarks (M, 3) that hold it, some of them drawn
        about what these measure, and draw them anew."""
        camera = self._scene.keyframes.rig.cameras[0]
        ray = pixels_to_normalized(camera, look.view.xy[located.corner_idx])
        sigma = 0.5 * self._options.error_px(camera) / camera.focal
        particles, (_, log_scale) = mode.particles, mode.particles.mean()
        spread = float(np.sqrt(particles.weight @ (particles.log_scale - log_scale) ** 2))
        num = max(MIN_PARTICLES, len(particles) // 2)
        fresh = drawn(located.cam_from_world, located.covariance, log_scale, spread, depth, num, self._rng)
        mixed = particles.joined(fresh, _RESEEDED).weighed(xyz, ray, sigma)
        mode.particles = mixed.resampled(mixed.num_wanted(depth), self._rng)
        pose, log_scale = mode.particles.mean()
        zoom = np.append(rigid3.IDENTITY, math.exp(log_scale))
        known_from_camera = similarity.compose(np.append(rigid3.inverse(pose), 1.0), zoom)
        mode.known_from_own = similarity.compose(known_from_camera, np.append(look.pose, 1.0))

    def _weigh(self) -> None:
        """Probabilities of all places, and of none."""
        look_alikes = self._scene.look_alikes
        for mode in self.modes:
            clusters = mode.tally.clusters(look_alikes.cluster)
            mode.score = mode.tally.score(look_alikes.cluster, clusters)
            if mode.score.support > 0.0:
                mode.score = mode.tally.score(look_alikes.cluster, clusters[look_alikes.is_repeated(clusters)])
        share = log_prior(len(self._scene.frame_idx))
        logs = np.array([math.log(NOT_IN_MAP), *[share + mode.score.total for mode in self.modes]])
        shares = np.exp(logs - logs.max())
        shares /= shares.sum()
        self.not_in_map = float(shares[0])
        for mode, probability in zip(self.modes, shares[1:], strict=True):
            mode.probability = float(probability)

    def _best(self) -> Mode | None:
        return max(self.modes, key=lambda mode: mode.probability, default=None)

    def _is_hopeless(self, mode: Mode) -> bool:
        best = max((m.score.total for m in self.modes), default=0.0)
        return mode.score.support < 0.0 and mode.score.total < best - _HOPELESS

    def _is_certain(self, best: Mode) -> bool:
        """Nothing else is likely, and what looks like it is contradicted."""
        newest = self._looks[-1].view
        if best.probability < 1.0 - MAX_DOUBT or best.score.is_contradicted:
            return False
        if best.located is None or not is_convincing(best.located, newest, self._options):
            return False
        refuted = best.score.against + math.log(MAX_DOUBT)
        return all(m is best or m.score.support <= 0.0 or m.score.against < refuted for m in self.modes)
