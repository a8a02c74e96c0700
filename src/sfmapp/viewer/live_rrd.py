"""Draws an odometry run with rerun, message by message.

Entities (everything on the timelines ``frame`` and ``time``)::

    world/scene                     turned so that up is up
    world/scene/live/map0/points, keyframes, path   blocks of the map and of the trajectory, as they are known
    world/scene/live/camera         where the camera is now
    world/scene/live/ground_truth          the true path so far, laid on the trajectory
    world/scene/final/map0/...      the result
    image, image/mapped, image/tracked   the frame, points that the pose was measured with, and the other tracks
    plots/points, time, error       numbers by frame
    known/landmarks, particles, places     a known map, and where the camera may be in it
    log                             decisions
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from sfmapp.evaluation.trajectory import Alignment, Trajectory
from sfmapp.geometry import rigid3, similarity
from sfmapp.geometry.orientation import upright_pixels, upright_poses, upright_xy
from sfmapp.geometry.upright import up_direction
from sfmapp.images.sources import printable
from sfmapp.odometry.result import FrameState
from sfmapp.viewer.live_scene import FRUSTUM_SHARE, Changed, LiveMap, frustum_lines, unbroken
from sfmapp.viewer.photos import shrunk_jpeg
from sfmapp.viewer.stage import eye_direction, frame_view, turn_to_z

Array = NDArray[np.float64]

APPLICATION = "sfmapp odometry"
FRAME_TIMELINE, TIME_TIMELINE = "frame", "time"
# 30 KB an image of 640 pixels: a thousand of them stay below 40 MB
_IMAGE_SIDE_PX, _IMAGE_QUALITY = 640, 70
_BLUE, _ORANGE, _GREEN, _GREY, _RED = (80, 150, 255), (255, 150, 40), (90, 200, 120), (140, 140, 150), (235, 70, 60)
_LIVE, _FINAL = "world/scene/live", "world/scene/final"
_MAX_FINAL_POINTS, _MAX_KNOWN_POINTS = 300_000, 30_000
# Where a known map is looked at from, and colours of the places that the camera may be at.
_ABOVE = np.array([-0.3, -0.3, 1.0]) / np.linalg.norm([-0.3, -0.3, 1.0])
_PLACES = np.array([_ORANGE, _BLUE, (200, 120, 230), (230, 210, 80), (120, 220, 220)])
# Points move with every keyframe; drawn as often they would take sixty megabytes of a recording of a thousand frames.
DRAW_EVERY = 8


class LiveDrawing:
    """A recording under way, to a file, to a viewer, or both."""

    def __init__(self, path: Path | None, url: str | None) -> None:
        self._recording = rr.RecordingStream(APPLICATION)
        sinks = [*([rr.FileSink(os.fspath(path))] if path else []), *([rr.GrpcSink(url)] if url else [])]
        self._recording.set_sinks(*sinks)
        self._maps: dict[int, LiveMap] = {}
        self._ground_truth: Trajectory | None = None
        self._alignment: Alignment = "sim3"
        self._count = self._drawn_at = 0
        self._is_lost = self._has_known_map = False
        self._begin_s = 0.0
        self._last = rigid3.IDENTITY
        self._newest: Mapping[str, Any] | None = None
        self._is_watched = url is not None
        self._shown_extent = 0.0
        self._rotation = turn_to_z(np.array([0.0, -1.0, 0.0]))
        self._drawers = {
            "begin": self._begin, "frame": self._frame, "map": self._map, "log": self._log, "end": self._end,
            "belief": self._belief,
        }  # fmt: skip

    def draw(self, message: Mapping[str, Any]) -> None:
        """Show what a message tells."""
        self._drawers[message["kind"]](message)

    def close(self) -> None:
        """Write out what is left."""
        self._recording.flush()
        self._recording.disconnect()

    # ------------------------------------------------------------------ messages

    def _begin(self, message: Mapping[str, Any]) -> None:
        recording, self._camera = self._recording, message["camera"]
        self._orientation = message["orientation"]
        self._rotation = turn_to_z(up_direction(upright_poses(rigid3.IDENTITY[None], [self._orientation])))
        self._has_ground_truth = message["ground_truth_times"] is not None
        if self._has_ground_truth:
            poses = message["ground_truth_cam_from_world"]
            self._ground_truth = Trajectory.from_cam_from_world(poses, message["ground_truth_times"])
            self._alignment = "se3" if message["is_metric"] else "sim3"
        recording.send_recording_name(printable(message["title"]))
        recording.send_blueprint(self._blueprint(None), make_active=True, make_default=True)
        recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        # cameras are taken to start level until more of them are known
        recording.log("world/scene", rr.Transform3D(mat3x3=self._rotation), static=True)
        # frusta and lines say it all; axes of no length are an error to the viewer
        for path in ("world/scene", _LIVE):
            recording.log(path, rr.TransformAxes3D(1e-6), static=True)
        for path, color, radius in (("mapped", _GREEN, 2.2), ("tracked", _ORANGE, 1.8)):
            fields = rr.Points2D.from_fields(radii=rr.Radius.ui_points(radius), colors=color)
            recording.log(f"image/{path}", fields, static=True)
        curves = [
            ("points/tracked", _ORANGE, "tracked"), ("points/mapped", _GREEN, "measured with"),
            ("time/tracking", _BLUE, "tracking"), ("error/live", _GREY, "live"), ("error/final", _GREEN, "final"),
        ]  # fmt: skip
        for name, color, label in curves:
            recording.log(f"plots/{name}", rr.SeriesLines(colors=[color], names=[label], widths=[1.5]), static=True)

    def _frame(self, message: Mapping[str, Any]) -> None:
        if self._count == 0:
            self._begin_s = message["timestamp_s"]
        self._count += 1
        self._set_time(message["frame_idx"], message["timestamp_s"])
        recording = self._recording
        self._draw_image(message)
        for name, value in (("tracked", message["num_tracked"]), ("mapped", message["num_mapped"])):
            recording.log(f"plots/points/{name}", rr.Scalars(value))
        recording.log("plots/time/tracking", rr.Scalars(1e3 * message["cpu_s"]))
        pose, map_idx = message["cam_from_world"], message["map_idx"]
        if not np.isfinite(pose[0]) or map_idx < 0:
            return
        ours = self._map_of(map_idx)
        block = ours.add_frame(message["frame_idx"], message["timestamp_s"], pose)
        self._draw_path(map_idx, {block})
        self._newest = message
        self._last = rigid3.compose(ours.placement, rigid3.inverse(pose))
        self._draw_camera(ours)

    def _map(self, message: Mapping[str, Any]) -> None:
        map_idx = message["map_idx"]
        ours = self._map_of(map_idx)
        ours.change(message)
        if message["is_complete"]:
            self._join(ours, map_idx)
        newest = self._newest
        if newest is not None and newest["frame_idx"] == message["frame_idx"] and newest["image"] is not None:
            ours.colour(self._camera, newest["cam_from_world"], newest["image"])
        if message["is_complete"] or self._count - self._drawn_at >= DRAW_EVERY:
            self._drawn_at = self._count
            self._draw_map(ours, map_idx)
            if self._ground_truth is not None:
                self._draw_ground_truth(ours, map_idx)

    def _join(self, ours: LiveMap, map_idx: int) -> None:
        """Maps whose keyframes are in this one now are drawn no more."""
        for other_idx, other in list(self._maps.items()):
            if other is not ours and other.keyframes and other.keyframes.keys() <= ours.keyframes.keys():
                ours.absorb(other)
                del self._maps[other_idx]
                self._recording.log(f"{_LIVE}/map{other_idx}", rr.Clear(recursive=True))

    def _draw_map(self, ours: LiveMap, map_idx: int) -> None:
        changed, ours.changed = ours.changed, Changed()
        self._draw_points(map_idx, changed.points)
        for block in sorted(changed.keyframes):
            lines = frustum_lines(self._camera, ours.keyframe_poses(block), ours.frustum or 0.1)
            strips = rr.LineStrips3D(lines, colors=_BLUE, radii=rr.Radius.ui_points(0.7))
            self._recording.log(f"{_LIVE}/map{map_idx}/keyframes/{block}", strips)
        self._draw_path(map_idx, changed.frames)
        if self._is_watched:
            self._step_back(ours)

    def _step_back(self, ours: LiveMap) -> None:
        """Keep a map that grows in view: not at every frame, for whoever watches may have turned the view."""
        poses = ours.frame_poses()
        poses = poses[np.isfinite(poses[:, 0])]
        if len(poses) < 2 or not ours.frustum:
            return
        xyz = ours.point_xyz[np.isfinite(ours.point_xyz[:, 0])].astype(np.float64)
        reach = ours.frustum / FRUSTUM_SHARE
        centers = rigid3.center(poses)
        near = np.linalg.norm(xyz - centers[-1], axis=1) < 2 * reach
        body = rigid3.apply(ours.placement, np.concatenate([centers, xyz[near]])) @ self._rotation.T
        extent = float(np.linalg.norm(np.ptp(body, axis=0)))
        if extent > 1.7 * self._shown_extent or extent < 0.3 * self._shown_extent:
            self._shown_extent = extent
            heading = rigid3.rotation_matrix(rigid3.compose(ours.placement, rigid3.inverse(poses[-1])))[:, 2]
            eye = frame_view(body, eye_direction(self._rotation @ heading))
            self._recording.send_blueprint(self._blueprint(eye), make_active=True, make_default=True)

    def _belief(self, message: Mapping[str, Any]) -> None:
        """Particles in a known map, each in the colour of its place, and the places with their probabilities."""
        recording = self._recording
        if message["point_xyz"] is not None:
            self._draw_known_map(message["point_xyz"])
        probability, is_decided = message["probability"], np.arange(len(message["probability"])) == message["decided"]
        colors = np.where(is_decided[:, None], _GREEN, np.resize(_PLACES, (len(probability), 3))).astype(np.uint8)
        # what weighs little is small
        radii = -np.clip(400.0 * message["weight"], 1.5, 5.0)
        recording.log("known/particles", rr.Points3D(message["center"], colors=colors[message["mode"]], radii=radii))
        lines = frustum_lines(self._camera, message["best"], self._known_frustum)
        labels = [f"{p:.2g}" for p in probability]
        places = rr.LineStrips3D(lines, colors=colors, labels=labels, radii=rr.Radius.ui_points(1.5))
        recording.log("known/places", places)
        recording.log("plots/belief/elsewhere", rr.Scalars(message["not_in_map"]))
        recording.log("plots/belief/best", rr.Scalars(float(probability.max()) if len(probability) else 0.0))

    def _draw_known_map(self, point_xyz: Array) -> None:
        """The landmarks of a known map, seen from above, in a view of their own."""
        self._has_known_map, recording = True, self._recording
        xyz = np.asarray(point_xyz[:: max(1, -(-len(point_xyz) // _MAX_KNOWN_POINTS))], np.float64)
        low, high = np.percentile(xyz, [5, 95], axis=0)
        self._known_frustum = 0.04 * float(np.linalg.norm(high - low))
        turned = xyz @ self._rotation.T
        self._known_eye = frame_view(turned[((xyz >= low) & (xyz <= high)).all(1)], _ABOVE)
        recording.send_blueprint(self._blueprint(None), make_active=True, make_default=True)
        recording.log("known", rr.Transform3D(mat3x3=self._rotation), static=True)
        recording.log("known", rr.TransformAxes3D(1e-6), static=True)
        landmarks = rr.Points3D(xyz, colors=_GREY, radii=rr.Radius.ui_points(1.0))
        recording.log("known/landmarks", landmarks, static=True)
        for name, color, label in (("best", _GREEN, "likeliest place"), ("elsewhere", _GREY, "not in the map")):
            series = rr.SeriesLines(colors=[color], names=[label], widths=[1.5])
            recording.log(f"plots/belief/{name}", series, static=True)

    def _blueprint(self, eye: tuple[Array, Array] | None) -> rrb.Blueprint:
        known_eye = self._known_eye if self._has_known_map else None
        return blueprint(eye, self._has_ground_truth, known_eye)

    def _log(self, message: Mapping[str, Any]) -> None:
        self._recording.log("log", rr.TextLog(message["text"], level=message["level"]))

    def _end(self, message: Mapping[str, Any]) -> None:
        """The result, a frame after the last, and with it what is up and a view of it all."""
        recording = self._recording
        if not len(message["frame_idx"]):
            return
        step = float(np.median(np.diff(message["timestamps_s"]))) if len(message["timestamps_s"]) > 1 else 0.1
        self._set_time(int(message["frame_idx"][-1]) + 1, float(message["timestamps_s"][-1]) + step)
        if np.isfinite(message["errors"]).any():
            known = np.isfinite(message["errors"])
            times = [
                rr.TimeColumn(FRAME_TIMELINE, sequence=message["frame_idx"][known]),
                rr.TimeColumn(TIME_TIMELINE, duration=message["timestamps_s"][known] - self._begin_s),
            ]
            recording.send_columns("plots/error/final", times, rr.Scalars.columns(scalars=message["errors"][known]))
        if not message["maps"]:
            return
        self._lay_live_on_final(message)
        recording.log(_LIVE, rr.Clear(recursive=True))
        bodies, headings = self._draw_final(message)
        has_pose = (message["frame_map"] == 0) & np.isfinite(message["cam_from_world"][:, 0])
        poses = message["cam_from_world"][has_pose]
        poses = poses[:: max(1, len(poses) // 1000)]
        rotation = turn_to_z(up_direction(upright_poses(poses, np.full(len(poses), self._orientation))))
        recording.log("world/scene", rr.Transform3D(mat3x3=rotation), static=True)
        direction = eye_direction((headings @ rotation.T).mean(0))
        eye = frame_view(np.concatenate(bodies) @ rotation.T, direction)
        recording.send_blueprint(self._blueprint(eye), make_active=True, make_default=True)

    def _lay_live_on_final(self, message: Mapping[str, Any]) -> None:
        """Scale, and what was corrected in the end, also hold for what was drawn before: nothing jumps when played."""
        position = {int(idx): k for k, idx in enumerate(message["frame_idx"])}
        for ours in self._maps.values():
            poses, idx = ours.frame_poses(), ours.frame_numbers
            rows = np.array([position.get(int(i), -1) for i in idx], np.int64)
            shared = (rows >= 0) & np.isfinite(poses[:, 0])
            shared[shared] &= message["frame_map"][rows[shared]] == 0
            if shared.sum() < 3:
                continue
            live = rigid3.compose(poses[shared], rigid3.inverse(ours.placement))
            try:
                fit = similarity.align_poses(live, message["cam_from_world"][rows[shared]]).b_from_a
            except ValueError:  # all in one place
                continue
            moved = rr.Transform3D(translation=fit[4:7], quaternion=fit[:4], scale=fit[7])
            self._recording.log(_LIVE, moved, static=True)
            return

    # ------------------------------------------------------------------ parts

    def _set_time(self, frame_idx: int, timestamp_s: float) -> None:
        self._recording.set_time(FRAME_TIMELINE, sequence=frame_idx)
        self._recording.set_time(TIME_TIMELINE, duration=timestamp_s - self._begin_s)

    def _map_of(self, map_idx: int) -> LiveMap:
        """A map; one that is new begins where the camera was last seen."""
        if map_idx not in self._maps:
            self._maps[map_idx] = LiveMap(self._last)
            placed = rr.Transform3D(translation=self._last[4:], quaternion=self._last[:4])
            self._recording.log(f"{_LIVE}/map{map_idx}", placed)
            self._recording.log(f"{_LIVE}/map{map_idx}", rr.TransformAxes3D(1e-6), static=True)
        return self._maps[map_idx]

    def _draw_image(self, message: Mapping[str, Any]) -> None:
        recording = self._recording
        if message["image"] is None:
            return
        upright = upright_pixels(message["image"], self._orientation)
        height, width = upright.shape
        data, (shown_width, _) = shrunk_jpeg(upright, _IMAGE_SIDE_PX, _IMAGE_QUALITY)
        recording.log("image", rr.EncodedImage(contents=data, media_type="image/jpeg"))
        if (message["state"] == FrameState.LOST) != self._is_lost:
            self._is_lost = not self._is_lost
            shown = [[shown_width, height * shown_width / width]]
            frame = rr.Boxes2D(mins=[[0.0, 0.0]], sizes=shown, colors=_RED, radii=3.0)
            recording.log("image/lost", frame if self._is_lost else rr.Clear(recursive=False))
        empty = np.zeros((0, 2), np.float32)
        xy, is_mapped = (empty, np.zeros(0, bool)) if message["xy"] is None else (message["xy"], message["is_mapped"])
        stored_height, stored_width = message["image"].shape
        xy = upright_xy(self._orientation, xy, stored_width, stored_height) * (shown_width / width)
        recording.log("image/mapped", rr.Points2D.from_fields(positions=xy[is_mapped]))
        recording.log("image/tracked", rr.Points2D.from_fields(positions=xy[~is_mapped]))

    def _draw_points(self, map_idx: int, blocks: set[int]) -> None:
        for block in sorted(blocks):
            xyz, grey = self._maps[map_idx].points(block)
            points = rr.Points3D(xyz, colors=np.repeat(grey[:, None], 3, 1), radii=rr.Radius.ui_points(1.5))
            self._recording.log(f"{_LIVE}/map{map_idx}/points/{block}", points)

    def _draw_path(self, map_idx: int, blocks: set[int]) -> None:
        for block in sorted(blocks):
            strips = rr.LineStrips3D(self._maps[map_idx].strips(block), colors=_ORANGE, radii=rr.Radius.ui_points(1.2))
            self._recording.log(f"{_LIVE}/map{map_idx}/path/{block}", strips)

    def _draw_camera(self, ours: LiveMap) -> None:
        lines = frustum_lines(self._camera, rigid3.inverse(self._last)[None], 1.5 * (ours.frustum or 0.1))
        # not a pinhole: the viewer refuses those where a parent has a scale, as the live view has in the end
        strips = rr.LineStrips3D(lines, colors=_ORANGE, radii=rr.Radius.ui_points(1.4))
        self._recording.log(f"{_LIVE}/camera", strips)

    def _draw_ground_truth(self, ours: LiveMap, map_idx: int) -> None:
        """The true path until now, laid on the trajectory as it is now."""
        assert self._ground_truth is not None
        fit = ours.against(self._ground_truth, self._alignment)
        if fit is None:
            return
        map_from_ground_truth, error = fit
        self._recording.log("plots/error/live", rr.Scalars(error))
        times = self._ground_truth.timestamps_s
        assert times is not None
        until = int(np.searchsorted(times, ours.last_time_s, side="right"))
        since = int(np.searchsorted(times, ours.first_time_s))
        xyz = similarity.apply(
            map_from_ground_truth, self._ground_truth.position[since:until][:: max(1, (until - since) // 2000)]
        )
        if len(xyz) > 1:
            strips = rr.LineStrips3D([xyz], colors=_GREEN, radii=rr.Radius.ui_points(1.0))
            self._recording.log(f"{_LIVE}/map{map_idx}/ground_truth", strips)

    def _draw_final(self, message: Mapping[str, Any]) -> tuple[list[Array], Array]:
        """All maps of the result in one scene; returns what a view has to hold, and where the cameras look."""
        recording = self._recording
        bodies: list[Array] = []
        headings: list[Array] = []
        for m, entry in enumerate(message["maps"]):
            place = placement(message, m, bodies)
            if place is None:
                continue
            mine = np.where((message["frame_map"] == m)[:, None], message["cam_from_world"], np.nan)
            known = np.isfinite(mine[:, 0])
            poses = np.full_like(mine, np.nan)
            poses[known] = similarity.transform_poses(place, mine[known])
            keyframes = similarity.transform_poses(place, entry["keyframe_cam_from_world"])
            xyz = similarity.apply(place, entry["point_xyz"].astype(np.float64))
            root = f"{_FINAL}/map{m}"
            kept = slice(None, None, max(1, -(-len(xyz) // _MAX_FINAL_POINTS)))
            points = rr.Points3D(xyz[kept], colors=entry["point_rgb"][kept], radii=rr.Radius.ui_points(1.5))
            recording.log(f"{root}/points", points)
            length = final_frustum(keyframes, xyz)
            frusta = frustum_lines(self._camera, keyframes, length)
            recording.log(f"{root}/keyframes", rr.LineStrips3D(frusta, colors=_BLUE, radii=rr.Radius.ui_points(0.7)))
            path = unbroken(rigid3.center(poses), np.arange(len(poses)))
            recording.log(f"{root}/path", rr.LineStrips3D(path, colors=_ORANGE, radii=rr.Radius.ui_points(1.6)))
            fits = message["ground_truth_from_map"]
            if self._ground_truth is not None and m < len(fits) and (fit := fits[m]) is not None:
                self._draw_final_ground_truth(root, similarity.compose(place, similarity.inverse(fit)), message, known)
            bodies.append(body_of(rigid3.center(poses[known]), xyz))
            headings.append(rigid3.rotation_matrix(poses[known])[:, 2])
        return bodies, np.concatenate(headings)

    def _draw_final_ground_truth(
        self, root: str, scene_from_ground_truth: Array, message: Mapping[str, Any], known: NDArray[np.bool_]
    ) -> None:
        assert self._ground_truth is not None
        assert self._ground_truth.timestamps_s is not None
        first, last = message["timestamps_s"][known][[0, -1]]
        during = (self._ground_truth.timestamps_s >= first) & (self._ground_truth.timestamps_s <= last)
        xyz = similarity.apply(scene_from_ground_truth, self._ground_truth.position[during])
        strips = rr.LineStrips3D([xyz], colors=_GREEN, radii=rr.Radius.ui_points(1.0))
        self._recording.log(f"{root}/ground_truth", strips)


def placement(message: Mapping[str, Any], m: int, bodies: Sequence[Array]) -> Array | None:
    """``scene_from_map`` (8,): where the ground truth says, or beside the maps before it; the first stays where it
    is."""
    if m == 0:
        return similarity.IDENTITY
    if not (message["frame_map"] == m).any() or not len(message["maps"][m]["keyframe_cam_from_world"]):
        return None
    fits = message["ground_truth_from_map"]
    if fits and fits[0] is not None and fits[m] is not None:
        return similarity.compose(similarity.inverse(fits[0]), fits[m])
    before = np.concatenate(bodies)
    size = np.ptp(bodies[0], axis=0).max()
    centers = rigid3.center(message["maps"][m]["keyframe_cam_from_world"])
    extent = np.ptp(centers, axis=0).max()
    scale = 1.0 if message["maps"][m]["unit"] or not extent > 0 else 0.4 * size / extent
    shift = np.array([before[:, 0].max() + 0.15 * size - scale * centers[:, 0].min(), 0.0, 0.0])
    return np.concatenate([rigid3.IDENTITY[:4], shift, [scale]])


def body_of(centers: Array, xyz: Array) -> Array:
    """(N, 3) the path, and the points that are not farther from its middle than it is long."""
    middle, half = centers.mean(0), np.ptp(centers, axis=0).max()
    near = xyz[(np.abs(xyz - middle) < half).all(1)]
    return np.concatenate([centers, near[:: max(1, len(near) // 5000)]])


def final_frustum(keyframes: Array, xyz: Array) -> float:
    """Length of the cameras: a share of the distance to what they see, no more than half the way to the next."""
    if not len(xyz) or len(keyframes) < 2:
        return 0.1
    centers = rigid3.center(keyframes)
    sample = xyz[:: max(1, len(xyz) // 2000)]
    nearest = np.median([np.linalg.norm(sample - c, axis=1).min() for c in centers[:: max(1, len(centers) // 50)]])
    apart = float(np.median(np.linalg.norm(np.diff(centers, axis=0), axis=1)))
    size = float(np.linalg.norm(np.ptp(centers, axis=0)))
    return float(np.clip(FRUSTUM_SHARE * 3 * nearest, 0.004 * size, max(0.6 * apart, 0.004 * size))) or 0.1


def blueprint(
    eye: tuple[Array, Array] | None, has_ground_truth: bool, known_eye: tuple[Array, Array] | None = None
) -> rrb.Blueprint:
    """The layout, looking at the map from an eye at a target, and beside the frame at a known map, if there is one."""
    world = _space("world", "Map and trajectory", eye)
    image: rrb.Spatial2DView | rrb.Horizontal = rrb.Spatial2DView(
        origin="image", name="Frame: green points are in the map, orange ones are not yet"
    )
    if known_eye is not None:
        image = rrb.Horizontal(image, _space("known", "Known map: where the camera may be", known_eye))
    shown = [("points", "Points"), ("time", "CPU time of tracking (ms)")]
    shown += [("error", "Distance from the ground truth (m)")] if has_ground_truth else []
    shown += [("belief", "Probability: place in the known map")] if known_eye is not None else []
    plots = [rrb.TimeSeriesView(origin=f"plots/{name}", name=label) for name, label in shown]
    columns = rrb.TextLogColumns(text_log_columns=["loglevel", "body"])
    log = rrb.TextLogView(origin="log", name="Decisions", columns=columns)
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(world, image, row_shares=[5, 3]),
            rrb.Vertical(*plots, log, row_shares=[*[2] * len(plots), 2]),
            column_shares=[5, 2],
        ),
        rrb.TimePanel(timeline=FRAME_TIMELINE, state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
    )


def _space(origin: str, name: str, eye: tuple[Array, Array] | None) -> rrb.Spatial3DView:
    controls = None
    if eye is not None:
        controls = rrb.EyeControls3D(position=eye[0], look_target=eye[1], eye_up=(0.0, 0.0, 1.0))
    return rrb.Spatial3DView(origin=origin, name=name, eye_controls=controls, line_grid=False)
