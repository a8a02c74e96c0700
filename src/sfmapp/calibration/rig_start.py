"""Where the refinement of a rig begins: poses between its cameras, and between boards, from boards seen at one moment.

Cameras that see the same board at the same moment know each other, as do boards that one camera sees at once. Cameras
that never do, and boards that never are, are joined by motion: if camera A sees board a while camera B sees board b,
all of it fixed to each other, then ``B_from_b(t) = X . A_from_a(t) . Y`` for every shot t, the robot-world hand-eye
calibration (Zhuang, Roth and Sudhakar, "Simultaneous robot/world and tool/flange calibration", IEEE TRA 10(4), 1994).
It takes turns about two axes.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3

Array = NDArray[np.float64]

# Turns about a second axis that are smaller than this share of those about the first tell nothing of it.
_SECOND_AXIS = 0.03
# Shots that hand-eye calibration needs: two motions.
_LEAST_SHOTS = 3


@dataclass(frozen=True)
class SeenBoard:
    """A board in a camera at a shot: positions, and the pose ``cam_from_board`` (7,) that the camera alone finds."""

    camera: int
    shot: int
    board: int
    cam_from_board: Array


@dataclass(frozen=True)
class JoinedRig:
    """What boards say of the cameras of a rig, and of each other.

    Attributes:
        cam_from_rig: (C, 7), NaN for cameras that nothing joins to the first.
        world_from_board: (B, 7), NaN alike.
        motions: pairs of cameras that only motion joins.
    """

    cam_from_rig: Array
    world_from_board: Array
    motions: tuple[tuple[int, int], ...]


def join_rig(seen: Sequence[SeenBoard], num_cameras: int, num_boards: int) -> JoinedRig:
    """Poses of cameras and of boards: best-known first, each from the most shots that know it."""
    groups = _Groups(seen, num_cameras, num_boards)
    motions: list[tuple[int, int]] = []
    while True:
        found = groups.best_link()
        if found is None:
            break
        by_motion = groups.join(*found)
        motions += [by_motion] if by_motion is not None else []
    cameras, boards = _members(groups.cameras, num_cameras), _members(groups.boards, num_boards)
    return JoinedRig(
        rigid3.compose(cameras, rigid3.inverse(cameras[0])),
        rigid3.compose(rigid3.inverse(boards[0]), boards),
        tuple(motions),
    )


class _Groups:
    """Cameras and boards whose poses in a common frame are known: each is at first a group of its own."""

    def __init__(self, seen: Sequence[SeenBoard], num_cameras: int, num_boards: int) -> None:
        self.seen = seen
        # by group: member -> pose member_from_group (cameras) or group_from_member (boards)
        self.cameras = [{c: rigid3.IDENTITY} for c in range(num_cameras)]
        self.boards = [{b: rigid3.IDENTITY} for b in range(num_boards)]

    def _views(self) -> dict[tuple[int, int], dict[int, Array]]:
        """By group of cameras and group of boards, the poses ``cameras_from_boards`` (7,) by shot."""
        camera_group = {c: g for g, group in enumerate(self.cameras) for c in group}
        board_group = {b: g for g, group in enumerate(self.boards) for b in group}
        gathered: dict[tuple[int, int], dict[int, list[Array]]] = {}
        for one in self.seen:
            g, h = camera_group[one.camera], board_group[one.board]
            member = rigid3.inverse(self.cameras[g][one.camera])
            pose = rigid3.compose(rigid3.compose(member, one.cam_from_board), rigid3.inverse(self.boards[h][one.board]))
            gathered.setdefault((g, h), {}).setdefault(one.shot, []).append(pose)
        return {key: {t: robust_pose(np.array(p)) for t, p in shots.items()} for key, shots in gathered.items()}

    def best_link(self) -> tuple[str, tuple[int, int], tuple[int, int], Array] | None:
        """The link that the most shots know: two groups of cameras, two of boards, or both at once by motion."""
        views = self._views()
        found: list[tuple[int, str, tuple[int, int], tuple[int, int], Array]] = []
        for (one, a), (two, b) in itertools.combinations(sorted(views.items()), 2):
            shots = sorted(a.keys() & b.keys())
            if not shots:
                continue
            first, second = np.array([a[t] for t in shots]), np.array([b[t] for t in shots])
            if one[1] == two[1]:
                # a large rank: what is seen at once is known better than by motion
                pose = robust_pose(rigid3.compose(second, rigid3.inverse(first)))
                found.append((len(shots) + 1_000_000, "cameras", one, two, pose))
            elif one[0] == two[0]:
                pose = robust_pose(rigid3.compose(rigid3.inverse(first), second))
                found.append((len(shots) + 1_000_000, "boards", one, two, pose))
            elif len(shots) >= _LEAST_SHOTS:
                solved = hand_eye(first, second)
                if solved is not None:
                    found.append((len(shots), "motion", one, two, np.stack(solved)))
        return max(found, key=lambda link: link[0])[1:] if found else None

    def join(self, kind: str, one: tuple[int, int], two: tuple[int, int], poses: Array) -> tuple[int, int] | None:
        """Put the second groups into the first; for a link by motion, the first cameras of both."""
        named = (min(self.cameras[one[0]]), min(self.cameras[two[0]])) if kind == "motion" else None
        if kind != "boards":
            second_from_first = poses[0] if kind == "motion" else poses
            for c, member in self.cameras[two[0]].items():
                self.cameras[one[0]][c] = rigid3.compose(member, second_from_first)
        if kind != "cameras":
            first_from_second = poses[1] if kind == "motion" else poses
            for b, member in self.boards[two[1]].items():
                self.boards[one[1]][b] = rigid3.compose(first_from_second, member)
        if kind != "boards":
            del self.cameras[two[0]]
        if kind != "cameras":
            del self.boards[two[1]]
        return named


def _members(groups: Sequence[Mapping[int, Array]], num: int) -> Array:
    """(N, 7) the poses of the group that holds the first member; NaN for others."""
    out = np.full((num, 7), np.nan)
    for member, pose in next(group for group in groups if 0 in group).items():
        out[member] = pose
    return out


def robust_pose(poses: Array) -> Array:
    """(7,) the pose that most of (N, 7) agree on.

    The one that is nearest to all others, then the mean of those near it, with Cauchy's weights. Turns are compared in
    radians, shifts relative to the length of that one's.
    """
    if len(poses) == 1:
        only: Array = poses[0].copy()
        return only
    rotation = rigid3.rotation_matrix(poses)
    length = max(float(np.median(np.linalg.norm(poses[:, 4:], axis=1))), 1e-12)

    def distances(r: Array, t: Array) -> Array:
        turn = np.radians(rigid3.rotation_angle_deg(rotation @ r.T))
        apart: Array = np.hypot(turn, np.linalg.norm(poses[:, 4:] - t, axis=1) / length)
        return apart

    total = [distances(rotation[i], poses[i, 4:]).sum() for i in range(len(poses))]
    best = int(np.argmin(total))
    r, t = rotation[best], poses[best, 4:]
    for _ in range(10):
        d = distances(r, t)
        weights = 1.0 / (1.0 + (d / (3.0 * max(float(np.median(d)), 1e-12))) ** 2)
        u, _, vt = np.linalg.svd(np.einsum("n,nij->ij", weights, rotation))
        r = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        t = weights @ poses[:, 4:] / weights.sum()
    return rigid3.from_matrix(r, t)


def hand_eye(first: Array, second: Array) -> tuple[Array, Array] | None:
    """X and Y (7,) of ``second(t) = X . first(t) . Y`` for poses (N, 7) each; None where the turns share one axis.

    X turns the axes of the first's motions into those of the second's (Kabsch), the shifts are linear then. Motions
    that do not agree count little.
    """
    r1, r2 = rigid3.rotation_matrix(first), rigid3.rotation_matrix(second)
    i, j = np.triu_indices(len(first), 1)
    axes1 = rigid3.log_so3(r1[i] @ r1[j].swapaxes(1, 2))
    axes2 = rigid3.log_so3(r2[i] @ r2[j].swapaxes(1, 2))
    values = np.linalg.svd(axes1, compute_uv=False)
    if len(values) < 2 or values[1] < _SECOND_AXIS * values[0]:
        return None
    # a turn about an axis has the same angle in both; near half a turn its axis may be either way round
    angle = np.linalg.norm(axes1, axis=1)
    weights = (angle < 0.95 * np.pi) / (1.0 + ((np.linalg.norm(axes2, axis=1) - angle) / 0.02) ** 2)
    x = np.eye(3)
    for _ in range(10):
        u, _, vt = np.linalg.svd((axes2 * weights[:, None]).T @ axes1)
        x = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        off = np.linalg.norm(axes2 - axes1 @ x.T, axis=1)
        scale = max(float(np.median(off)), 1e-9)
        weights = (angle < 0.95 * np.pi) / (1.0 + (off / (3.0 * scale)) ** 2)
    turned = r1.swapaxes(1, 2) @ x.T @ r2
    y = rigid3.rotation_matrix(robust_pose(rigid3.from_matrix(turned, np.zeros((len(turned), 3)))))
    rows = np.concatenate([np.broadcast_to(np.eye(3), (len(first), 3, 3)), x @ r1], 2).reshape(-1, 6)
    right = (second[:, 4:] - first[:, 4:] @ x.T).ravel()
    share = np.ones(len(right))
    shifts = np.zeros(6)
    for _ in range(10):
        root = np.sqrt(share)
        shifts = np.linalg.lstsq(rows * root[:, None], right * root, rcond=None)[0]
        off = np.repeat(np.linalg.norm((right - rows @ shifts).reshape(-1, 3), axis=1), 3)
        share = 1.0 / (1.0 + (off / (3.0 * max(float(np.median(off)), 1e-12))) ** 2)
    return rigid3.from_matrix(x, shifts[:3]), rigid3.from_matrix(y, shifts[3:])
