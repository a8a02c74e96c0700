"""Whether the two cameras of a rig look at the same moment, from the right side, and the right way up.

A point that the left camera follows moves between two frames, and its epipolar line in the right image moves along. A
match in the right image that lies between the two lines tells when it was taken: with off(0) the distance of the match
from the line of now and off(1) from that of the frame before, it is ``off + late * (off(1) - off(0)) = 0``. That is
linear in the lateness, which needs no map and no scale, and it tells parts of a frame as well as whole ones. A rig that
is turned against what is known moves the lines as well, but not with the motion: the turn is fitted along.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import pixels_to_normalized, project
from sfmapp.contradictions import Contradiction
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.images.sequence import Frame
from sfmapp.odometry.frontend.alignment import align_patches
from sfmapp.odometry.frontend.corners import find_corners
from sfmapp.odometry.frontend.pyramid import Pyramid, build_pyramid
from sfmapp.odometry.frontend.stereo import match_stereo
from sfmapp.odometry.map.keyframe_map import KeyframeMap
from sfmapp.odometry.map.local_map import View
from sfmapp.scene.rig import Rig

Array = NDArray[np.float64]
Pyramids = tuple[Pyramid, ...]

# Corners of a look, the level on which they are looked for (80 pixels around), and how alike they have to be. What is
# so near that it lies farther off is looked for along its line; half of the corners found there make a pair.
_CORNERS, _LEVEL, _LIKENESS, _NEAR_SHARE = 300, 4, 0.8, 0.5
# Fewest matches that a look is fitted to; least motion of the lines between frames, several times the noise of a match.
_MIN_MATCHES, _MIN_MOTION_PX = 30, 0.5
# What a rig may be turned by, about each axis, and how much longer one lens may be: real cars show half a degree.
_TURN_SIGMA_DEG, _LENGTH_SIGMA, _NOISE_PX = 0.3, 0.01, 0.05
_LOSS_SIGMAS, _ROBUST_STEPS = 2.385, 10
# A look is informative if it tells the moment to that share of a frame; so many in a row decide together.
_INFORMATIVE, _IN_A_ROW = 0.05, 5
# Cameras that are triggered together are found within 0.005 frames of each other on rendered and real sequences.
# What moves the rig by less than that share of its baseline does not count: calibrations are no better.
_MIN_LATE, _MIN_SIGMAS, _MIN_MOVED = 0.03, 5.0, 0.005
# Frames that are held back to see whether the cameras are in step, in number and bytes, and those between two looks.
_MAX_HELD, _MAX_HELD_BYTES, _HELD_STEP = 64, 1 << 28, 2
# Whole frames are taken out where at least so much is found, as a motion that changes within a frame hides a part of
# it; what is left afterwards must be less than a half.
_MIN_SHIFT, _MAX_LEFT, _MAX_ROUNDS = 0.25, 0.5, 4
# Looks that are kept: as the next one comes every other is dropped, and every other is left out from then on.
_MAX_LOOKS = 48
# Farther behind infinity than that share of the focal length (0.6 degrees) nothing lies, were the rig turned or not.
_BEHIND = 0.01
# Fewest of the points with a disparity beyond that which are on the wrong side where the baseline is: the rest are
# mismatches. Fewest points that one image may share with the other, of those that the left one shares with the frame
# before: unrelated images share a tenth by chance.
_BEHIND_SHARE, _COMMON_SHARE = 0.9, 0.15
# Matches nearer than that to their line, and not behind infinity, are partners. Of the matches of a rig that is right
# 87 to 99 % are, of one that is a frame late, swapped or elsewhere 0 to 47 %.
_PARTNER_PX, _MIN_PARTNERS = 1.5, 0.6
# What the scale may drift by where the map goes on without the right images, as a relative standard deviation.
_DRIFT = 0.05


@dataclass(frozen=True)
class Look:
    """What one frame tells.

    Attributes:
        frame_idx: which. step_s: since the frame before.
        off_px: (N,) distance of matches from their epipolar lines; motion_px: (N,) how that changes to the line of the
            frame before. columns: (N, 4) how it changes with a turn of the right camera (radians) and its length.
        disparity: (N,) along the line from infinity towards the camera, in focal lengths.
        num_left, num_right: corners found again in the frame before, and in the right image.
        num_near, num_turned, num_swapped: found along the epipolar lines, and in the right image turned by 180 degrees,
            and partners were the images exchanged; looked for where the images do not fit as they are.
    """

    frame_idx: int
    step_s: float
    off_px: Array
    motion_px: Array
    columns: Array
    disparity: Array
    num_left: int
    num_right: int
    num_turned: int = 0
    num_swapped: int = 0
    num_near: int = 0

    @property
    def num_partners(self) -> int:
        """Matches near their line and not behind infinity."""
        return int(((np.abs(self.off_px) < _PARTNER_PX) & (self.disparity > -_BEHIND)).sum())

    @property
    def is_right(self) -> bool:
        """Most matches are partners, and there are some, unless the left image alone says nothing."""
        return self.fits(1.0)

    def fits(self, share: float) -> bool:
        """:attr:`is_right` with limits of that share."""
        if self.num_near >= share * _NEAR_SHARE * self.num_left:
            return True
        if len(self.off_px) >= _MIN_MATCHES:
            return self.num_partners >= share * _MIN_PARTNERS * len(self.off_px)
        return self.num_left < _MIN_MATCHES or self.num_right >= _COMMON_SHARE * self.num_left


@dataclass(frozen=True)
class TimeOffset:
    """How late the right camera is, in frames: of all looks together, and of each (NaN where it does not tell)."""

    frames: float
    of_looks: Array

    @property
    def is_known(self) -> bool:
        """Enough looks tell, and they agree."""
        told = self.of_looks[np.isfinite(self.of_looks)]
        return len(told) >= _IN_A_ROW and float(np.median(np.abs(told - self.frames))) < _INFORMATIVE


def look(rig: Rig, before: Pyramid, pyramids: Pyramids, frame_idx: int, step_s: float) -> Look:
    """Look for corners of the left image in the frame before and in the right image, wherever they are.

    Args:
        before: the left image of the frame before. pyramids: the left and right image of this one.
    """
    seen = _look(rig, before, pyramids, frame_idx, step_s)
    if not seen.is_right:
        xy = _corners(pyramids[0])
        near = match_stereo(rig, pyramids, xy, np.full(len(xy), np.nan))
        seen = replace(seen, num_near=int(np.isfinite(near[:, 0]).sum()))
    if seen.is_right:
        return seen
    if seen.num_right < _COMMON_SHARE * seen.num_left:
        turned = build_pyramid(np.ascontiguousarray(pyramids[1].level(0)[::-1, ::-1]))
        return replace(seen, num_turned=_look(rig, before, (pyramids[0], turned), frame_idx, step_s).num_right)
    swapped = (pyramids[1], pyramids[0])
    return replace(seen, num_swapped=_look(rig, pyramids[1], swapped, frame_idx, step_s).num_partners)


def _corners(image: Pyramid) -> Array:
    height, width = image.shape
    spacing = 0.5 * float(np.sqrt(height * width / _CORNERS))
    return find_corners(image, np.empty((0, 2)), _CORNERS, min_distance_px=spacing)


def _look(rig: Rig, before: Pyramid, pyramids: Pyramids, frame_idx: int, step_s: float) -> Look:
    left, right = pyramids[:2]
    xy = _corners(left)
    rotation, baseline = rigid3.rotation_matrix(rig.cam_from_rig[1]), rig.cam_from_rig[1][4:]
    far = _rays(rig, 0, xy) @ rotation.T
    then, is_left = _aligned(left, xy, before, xy)
    there, is_right = _aligned(left, xy, right, np.nan_to_num(project(rig.cameras[1], far), nan=-1e6))
    both = is_left & is_right
    here, far = _rays(rig, 1, there[both]), far[both]
    line, line_before = (_lines(points, baseline) for points in (far, _rays(rig, 0, then[both]) @ rotation.T))
    focal = rig.cameras[1].focal
    off = (line * here).sum(1)
    along = baseline[:2] * far[:, 2:] - far[:, :2] * baseline[2]
    along /= np.linalg.norm(along, axis=1)[:, None]
    disparity = ((here[:, :2] - far[:, :2] / far[:, 2:]) * along).sum(1)
    columns = np.column_stack([np.cross(line, here), (line[:, :2] * here[:, :2]).sum(1)])
    finite = np.isfinite(disparity) & np.isfinite(line_before[:, 0])
    return Look(
        frame_idx, step_s, focal * off[finite], focal * ((line_before * here).sum(1) - off)[finite],
        focal * columns[finite], disparity[finite], int(is_left.sum()), int(is_right.sum()),
    )  # fmt: skip


def _rays(rig: Rig, sensor: int, xy: Array) -> Array:
    return np.column_stack([pixels_to_normalized(rig.cameras[sensor], xy), np.ones(len(xy))])


def _aligned(image: Pyramid, xy: Array, other: Pyramid, guess: Array) -> tuple[Array, NDArray[np.bool_]]:
    found = align_patches(image, xy, other, guess, coarsest_level=_LEVEL)
    return found.xy, found.is_converged & (found.zncc > _LIKENESS)


def _lines(far: Array, baseline: Array) -> Array:
    """(N, 3) epipolar lines of rays (N, 3) that are turned into the right camera, with normals of unit length."""
    line = far @ rigid3.skew(baseline).T
    return np.asarray(line / np.linalg.norm(line[:, :2], axis=1)[:, None], np.float64)


def estimate_time_offset(looks: list[Look]) -> TimeOffset:
    """Fit the lateness of the right camera to all looks, with one turn of it, robustly."""
    told = np.full(len(looks), np.nan)
    usable = [n for n, seen in enumerate(looks) if len(seen.off_px) >= _MIN_MATCHES]
    usable = [n for n in usable if np.median(np.abs(looks[n].motion_px)) > _MIN_MOTION_PX]
    if not usable:
        return TimeOffset(float("nan"), told)
    step = float(np.median([looks[n].step_s for n in usable]))
    motion = [looks[n].motion_px * step / looks[n].step_s for n in usable]
    off = np.concatenate([looks[n].off_px for n in usable])
    columns = np.column_stack([np.concatenate(motion), np.concatenate([looks[n].columns for n in usable])])
    fits = [_fit(off, columns, float(start)) for start in (-2, -1, 0, 1, 2)]
    late, turn = min(fits, key=lambda fit: float(np.median(np.abs(off + columns @ np.append(fit[0], fit[1])))))
    for n, of_motion in zip(usable, motion, strict=True):
        told[n] = _fit_one(looks[n].off_px + looks[n].columns @ turn, of_motion, late)
    return TimeOffset(late, told)


def _fit(off: Array, columns: Array, start: float) -> tuple[float, Array]:
    """The lateness and the turn (4,) that bring matches back to their lines, from a first guess of the lateness."""
    prior = np.diag([0.0, *[np.radians(_TURN_SIGMA_DEG) ** -2.0] * 3, _LENGTH_SIGMA**-2.0])
    found = np.array([start, 0.0, 0.0, 0.0, 0.0])
    for _ in range(_ROBUST_STEPS):
        left = off + columns @ found
        sigma = max(1.4826 * float(np.median(np.abs(left))), _NOISE_PX)
        weight = 1 / (sigma**2 + (left / _LOSS_SIGMAS) ** 2)
        found = -np.linalg.solve((columns.T * weight) @ columns + prior, columns.T @ (weight * off))
    return float(found[0]), found[1:]


def _fit_one(off: Array, motion: Array, late: float) -> float:
    """The lateness that one look tells; NaN if it does not tell it well."""
    for _ in range(_ROBUST_STEPS):
        left = off + late * motion
        sigma = max(1.4826 * float(np.median(np.abs(left))), _NOISE_PX)
        weight = 1 / (sigma**2 + (left / _LOSS_SIGMAS) ** 2)
        information = float((weight * motion**2).sum())
        late = -float((weight * motion * off).sum()) / information
    return late if information > _INFORMATIVE**-2.0 else float("nan")


class StereoClock:
    """Holds the cameras of a rig against each other while a sequence is played. Says nothing of a single camera.

    Attributes:
        shift: frames that the right images have been moved by: the right camera was so many late.
        is_usable: False where the first frames say that the rig is not what it is said to be.
    """

    def __init__(self, rig: Rig) -> None:
        self._rig, self._looks, self._stride, self._asked = rig, list[Look](), 1, 0
        self._is_right = self.is_usable = True
        self.shift = 0

    def pair(self, frames: Iterator[Frame], events: Events) -> Iterator[Frame]:
        """The frames, each with the right image that shows its moment where the first ones tell which that is."""
        if not self._rig.is_stereo:
            yield from frames
            return
        held, room = list[Frame](), _MAX_HELD
        for frame in frames:
            held.append(frame)
            room = min(room, max(8, _MAX_HELD_BYTES // sum(image.nbytes for image in frame.images)))
            if len(held) % _HELD_STEP == 0:
                self._looks += self._look_back(held, len(held) - 1, 0)
                if estimate_time_offset(self._looks).is_known:
                    break
            if len(held) >= room:
                break
        self._settle(held)
        if self.shift:
            when = f"{abs(self.shift)} frame{'s' * (abs(self.shift) > 1)} {'late' if self.shift > 0 else 'early'}"
            events.warned("odometry", f"the right camera is {when}: its images are paired again", shift=self.shift)
        against = _mounting(self._looks)
        if 2 * sum(not seen.is_right for seen in self._looks) > len(self._looks):
            against = against or ([] if estimate_time_offset(self._looks).is_known else _strangers(self._looks))
        self.is_usable = not against
        for found in against:
            events.warned("odometry", found.message)
        yield from _shifted(held, frames, self.shift)

    def _look_back(self, held: list[Frame], n: int, shift: int) -> list[Look]:
        """The look at a frame that is held, paired with the right image of another."""
        if not 0 <= n + shift < len(held) or min(len(held[n].images), len(held[n + shift].images)) < 2:
            return []
        before, left, right = (
            build_pyramid(image) for image in (held[n - 1].images[0], held[n].images[0], held[n + shift].images[1])
        )
        step_s = held[n].timestamp_s - held[n - 1].timestamp_s
        return [look(self._rig, before, (left, right), held[n].idx, step_s)]

    def _settle(self, held: list[Frame]) -> None:
        """Find the whole frames that the cameras are apart, from the frames that are held."""
        shift, late, partners = 0, estimate_time_offset(self._looks).frames, _partner_share(self._looks)
        for _ in range(_MAX_ROUNDS):
            if not abs(late) > _MIN_SHIFT:
                break
            shift += int(np.sign(late)) * max(1, int(np.rint(abs(late))))
            looks = [s for n in range(1, len(held), _HELD_STEP) for s in self._look_back(held, n, shift)]
            left, share = estimate_time_offset(looks).frames, _partner_share(looks)
            if share > partners and abs(left) < _MAX_LEFT:
                self.shift, self._looks, partners = shift, looks, share
            late = left

    def look(self, before: Pyramid, view: View, before_s: float) -> View:
        """Look at a keyframe as it is played.

        Args:
            before: the left image of the frame before, of the time before_s.

        Returns:
            The view, without its right image where that does not fit.
        """
        if len(view.pyramids) < 2:
            return view
        self._asked += 1
        if self._asked % self._stride == 0:
            seen = look(self._rig, before, view.pyramids, view.frame_idx, view.timestamp_s - before_s)
            self._is_right = seen.is_right
            self._looks.append(seen)
            if len(self._looks) > _MAX_LOOKS:
                del self._looks[::2]
                self._stride *= 2
        return view if self._is_right else replace(view, images=view.images[:1], pyramids=view.pyramids[:1])

    def contradictions(self, keyframes: KeyframeMap | None = None) -> list[Contradiction]:
        """What the right images say against the rig and the clock, over the time of a map or all of it."""
        looks = self._looks
        if keyframes is not None and len(keyframes.keyframes) > 1:
            first, last = keyframes.keyframes[0].frame_idx, keyframes.keyframes[-1].frame_idx
            looks = [seen for seen in looks if first <= seen.frame_idx <= last]
        return _mounting(looks) or _lateness(looks, self._rig, keyframes) or _strangers(looks) if looks else []


def _shifted(held: list[Frame], frames: Iterator[Frame], shift: int) -> Iterator[Frame]:
    """All frames with the right images of those ``shift`` later; the left image alone where there is none."""
    queue = list[Frame]()
    rights = dict[int, tuple[NDArray[np.uint8], ...]]()
    position = 0

    def everything() -> Iterator[Frame]:
        yield from held
        yield from frames

    for number, frame in enumerate(everything()):
        if shift == 0:
            yield frame
            continue
        queue.append(frame)
        rights[number] = frame.images[1:]
        while queue and position + max(shift, 0) <= number:
            yield _with_right(queue.pop(0), rights.get(position + shift, ()))
            rights.pop(position + min(shift, 0), None)
            position += 1
    for frame in queue:
        yield _with_right(frame, ())


def _with_right(frame: Frame, right: tuple[NDArray[np.uint8], ...]) -> Frame:
    return replace(frame, images=(frame.images[0], *right))


def _partner_share(looks: list[Look]) -> float:
    """The share of the corners followed in the left images that have a partner on the right."""
    return sum(seen.num_partners for seen in looks) / max(1, sum(seen.num_left for seen in looks))


def _mounting(looks: list[Look]) -> list[Contradiction]:
    """Cameras that are exchanged or upside down, or that do not see the same place at all."""
    num_left, num_right = sum(s.num_left for s in looks), sum(max(s.num_right, s.num_near) for s in looks)
    num_turned, num_swapped = sum(seen.num_turned for seen in looks), sum(seen.num_swapped for seen in looks)
    num_partners = sum(seen.num_partners for seen in looks)
    disparity = np.concatenate([np.zeros(0), *(seen.disparity for seen in looks)])
    apart = np.abs(disparity) > _BEHIND
    behind = float((disparity[apart] < 0).mean()) if apart.any() else 0.0
    if num_left < _MIN_MATCHES * len(looks) / 2:
        return []
    found = f"{num_right} of {num_left} corners of the left images are found in the right ones"
    if num_right < _COMMON_SHARE * num_left and num_turned > 2 * _COMMON_SHARE * num_left:
        subject, advice = "mounting of the cameras", "turn the images of the right camera"
        message = f"the right camera is upside down: {found}, {num_turned} with these turned by 180 degrees"
    elif num_right < _COMMON_SHARE * num_left:
        subject, advice = "pairs of images", "check that both cameras belong to one recording, or use --mono"
        message = f"the cameras do not see the same place: {found}"
    elif num_swapped > _MIN_PARTNERS * num_right and num_swapped > 2 * num_partners:
        subject, advice = "order of the cameras", "exchange left and right"
        message = (
            f"left and right are swapped: {num_partners} of {num_right} matches agree with the rig, {num_swapped} with "
            "the images exchanged"
        )
    elif behind > _BEHIND_SHARE and apart.sum() > _COMMON_SHARE * num_left and not any(s.is_right for s in looks):
        subject, advice = "order of the cameras", "turn the baseline's sign, or exchange left and right"
        message = (
            "the baseline has the wrong sign, or left and right are swapped: "
            f"{behind:.0%} of {int(apart.sum())} matches lie behind the cameras"
        )
    else:
        return []
    evidence = {
        "num_corners": num_left, "num_right": num_right, "num_partners": num_partners, "num_turned": num_turned,
        "num_swapped": num_swapped, "share_behind": behind,
    }  # fmt: skip
    return [Contradiction(subject, message, advice, evidence, 180.0, 1.0, 1.0)]


def _strangers(looks: list[Look]) -> list[Contradiction]:
    """Right images that do not fit for a reason that is not known."""
    wrong = [seen.frame_idx for seen in looks if not seen.fits(0.5)]
    if len(wrong) <= 0.1 * len(looks):
        return []
    share = sum(seen.num_partners for seen in looks) / max(1, sum(len(seen.off_px) for seen in looks))
    message = (
        f"{len(wrong)} of {len(looks)} pairs do not fit the rig, between frames {wrong[0]} and {wrong[-1]}: "
        f"{share:.0%} of all matches lie on their epipolar lines"
    )
    advice = "check the calibration of the rig and that the images of a pair were taken together, or use --mono"
    evidence = {"num_wrong": len(wrong), "num_looks": len(looks), "share_on_lines": share, "min_share": _MIN_PARTNERS}
    sigma = len(wrong) / len(looks)
    return [Contradiction("pairs of images", message, advice, evidence, 0.0, sigma, sigma)]


def _lateness(looks: list[Look], rig: Rig, keyframes: KeyframeMap | None) -> list[Contradiction]:
    """Cameras that do not look at the same moment, all the time or for a while."""
    late = estimate_time_offset(looks)
    told = np.flatnonzero(np.isfinite(late.of_looks))
    if len(told) < _IN_A_ROW:
        return []
    runs = np.lib.stride_tricks.sliding_window_view(late.of_looks[told], _IN_A_ROW)
    middle = np.median(runs, 1)
    sigma = 1.4826 * np.median(np.abs(runs - middle[:, None]), 1) / np.sqrt(_IN_A_ROW)
    beyond = (np.abs(middle) > _MIN_LATE) & (np.abs(middle) > _MIN_SIGMAS * sigma)
    if not beyond.any():
        return []
    when, frames = "", float(np.median(late.of_looks[told]))
    if not beyond.all():
        frames = float(middle[beyond][np.argmax(np.abs(middle[beyond]))])
        first, last = told[np.flatnonzero(beyond)[[0, -1]] + [0, _IN_A_ROW - 1]]
        when = f" between frames {looks[first].frame_idx} and {looks[last].frame_idx}"
    step_s = float(np.median([seen.step_s for seen in looks]))
    unused = float(np.mean([not seen.is_right for seen in looks]))
    used = late.of_looks[[n for n in told if looks[n].is_right]]
    used_s = step_s * float(np.sqrt((used**2).mean())) if len(used) else 0.0
    moved, turned_deg = (0.0, 0.0) if keyframes is None else _motion(keyframes, used_s)
    baseline = float(np.linalg.norm(rigid3.center(rig.cam_from_rig[1])))
    share = moved / baseline
    if keyframes is not None and _motion(keyframes, abs(frames) * step_s)[0] < _MIN_MOVED * baseline:
        return []
    evidence = {
        "late_frames": frames, "late_s": frames * step_s, "min_frames": _MIN_LATE, "num_looks": len(told),
        "partner_share": _partner_share(looks), "unused_share": unused, "moved_share_of_baseline": share,
    }  # fmt: skip
    scale_sigma = float(np.hypot(share, _DRIFT * unused))
    message = (
        f"the right camera is {abs(frames):.2f} frames ({1000 * abs(frames) * step_s:.1f} ms) "
        f"{'late' if frames > 0 else 'early'}{when}: {_partner_share(looks):.0%} of the corners have a partner on the "
        f"right, and {unused:.0%} of the right images are left out"
    )
    advice = "pair the images by the moment at which they were taken, or use --mono"
    return [Contradiction("clock of the cameras", message, advice, evidence, turned_deg, scale_sigma, scale_sigma)]


def _motion(keyframes: KeyframeMap, duration_s: float) -> tuple[float, float]:
    """How far the rig moves and how many degrees it turns in a time: rms over the keyframes."""
    poses = np.array([k.rig_from_world for k in keyframes.keyframes])
    times = np.array([k.timestamp_s for k in keyframes.keyframes])
    if len(poses) < 2:
        return 0.0, 0.0
    share = duration_s / np.diff(times)
    moved = np.linalg.norm(np.diff(rigid3.center(poses), axis=0), axis=1) * share
    rotation = rigid3.rotation_matrix(poses)
    turned = np.degrees(np.linalg.norm(rigid3.log_so3(rotation[1:] @ rotation[:-1].swapaxes(1, 2)), axis=1)) * share
    return float(np.sqrt((moved**2).mean())), float(np.sqrt((turned**2).mean()))
