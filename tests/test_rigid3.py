"""Group axioms of rigid motions, and agreement with scipy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation, Slerp

from sfmapp.errors import InputError
from sfmapp.geometry import rigid3
from sfmapp.geometry.pnp import quaternion_of
from sfmapp.geometry.rigid3 import Rigid3

vectors = arrays(np.float64, (3,), elements=st.floats(-10, 10))
poses = st.builds(lambda w, t: rigid3.from_matrix(rigid3.exp_so3(w), t), vectors, vectors)


@given(poses, poses, poses, vectors)
def test_composition_is_associative_and_acts_on_points(a, b, c, x):
    left = rigid3.compose(rigid3.compose(a, b), c)
    right = rigid3.compose(a, rigid3.compose(b, c))
    np.testing.assert_allclose(rigid3.apply(left, x), rigid3.apply(right, x), atol=1e-12)
    np.testing.assert_allclose(rigid3.apply(left, x), rigid3.apply(a, rigid3.apply(b, rigid3.apply(c, x))), atol=1e-12)


def test_one_pose_and_many_give_the_same_bits_and_so_does_the_kernel_to_rounding():
    rng = np.random.default_rng(0)
    rotations = rigid3.exp_so3(2.0 * rng.normal(size=(500, 3)))
    rotations[:4] = np.eye(3), np.diag([1.0, -1, -1]), np.diag([-1.0, 1, -1]), np.diag([-1.0, -1, 1])
    quaternions, in_kernel = rigid3.quaternion(rotations), np.empty(4)
    for rotation, quaternion in zip(rotations, quaternions, strict=True):
        assert rigid3.quaternion(rotation).tobytes() == quaternion.tobytes()
        quaternion_of(rotation, in_kernel)
        np.testing.assert_allclose(in_kernel, quaternion, atol=1e-15)
    one_by_one = np.array([rigid3.rotation_matrix(quaternion) for quaternion in quaternions])
    assert one_by_one.tobytes() == rigid3.rotation_matrix(quaternions).tobytes()


@given(poses, vectors)
def test_inverse_undoes(pose, x):
    np.testing.assert_allclose(rigid3.apply(rigid3.inverse(pose), rigid3.apply(pose, x)), x, atol=1e-12)
    np.testing.assert_allclose(rigid3.apply(pose, rigid3.center(pose)), 0.0, atol=1e-12)


@given(arrays(np.float64, (3,), elements=st.floats(-3, 3)))
def test_exp_and_log_agree_with_scipy(w):
    rotation = rigid3.exp_so3(w)
    oracle = Rotation.from_rotvec(w)
    np.testing.assert_allclose(rotation, oracle.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(rigid3.exp_so3(rigid3.log_so3(rotation)), rotation, atol=1e-9)
    quaternion = rigid3.quaternion(rotation)
    assert abs(abs(quaternion @ oracle.as_quat()) - 1) < 1e-12
    assert quaternion[3] >= 0


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0.8, 0]])
@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 1e-4, np.pi - 1e-7, np.pi])
def test_exp_and_log_at_the_ends(axis, angle):
    rotation = rigid3.exp_so3(angle * np.array(axis))
    assert rigid3.rotation_angle_deg(rotation) == pytest.approx(np.degrees(angle), abs=1e-9)
    np.testing.assert_allclose(rigid3.exp_so3(rigid3.log_so3(rotation)), rotation, atol=1e-12)


@given(poses, vectors, vectors)
def test_centres_move_as_their_jacobian_says(pose, w, v):
    step = 1e-7
    moved = rigid3.compose(rigid3.from_matrix(rigid3.exp_so3(step * w), step * v), pose)
    tangent = np.concatenate([w, v])
    np.testing.assert_allclose(
        (rigid3.center(moved) - rigid3.center(pose)) / step, rigid3.center_jacobian(pose) @ tangent, atol=1e-4
    )
    along = rigid3.center_covariance(pose, np.outer(tangent, tangent))
    np.testing.assert_allclose(along, np.outer(*2 * [rigid3.center_jacobian(pose) @ tangent]), atol=1e-9)


def test_functions_broadcast():
    rng = np.random.default_rng(0)
    many = rigid3.from_matrix(rigid3.exp_so3(rng.normal(size=(4, 5, 3))), rng.normal(size=(4, 5, 3)))
    one = rigid3.compose(many[2, 3], many[1, 1])
    np.testing.assert_allclose(rigid3.compose(many, many[1, 1])[2, 3], one, atol=1e-14)
    np.testing.assert_allclose(rigid3.inverse(many)[3, 4], rigid3.inverse(many[3, 4]), atol=1e-14)


@given(poses, poses, st.floats(0, 1))
def test_interpolation_agrees_with_scipy_and_moves_the_centre_on_a_line(first, last, share):
    rotations = Rotation.from_matrix(rigid3.rotation_matrix(np.stack([first, last])))
    if (rotations[1] * rotations[0].inv()).magnitude() > 3.1:  # the way round is open
        return
    found = rigid3.interpolate(first, last, share)
    oracle = Slerp([0.0, 1.0], rotations)(share)
    np.testing.assert_allclose(rigid3.rotation_matrix(found), oracle.as_matrix(), atol=1e-9)
    centers = (1 - share) * rigid3.center(first) + share * rigid3.center(last)
    np.testing.assert_allclose(rigid3.center(found), centers, atol=1e-12)


def test_interpolation_of_many_is_that_of_each():
    rng = np.random.default_rng(0)
    first, last = rigid3.from_matrix(rigid3.exp_so3(rng.normal(size=(2, 5, 3))), rng.normal(size=(2, 5, 3)))
    shares = rng.random(5)
    each = [rigid3.interpolate(*row) for row in zip(first, last, shares, strict=True)]
    np.testing.assert_array_equal(rigid3.interpolate(first, last, shares), each)
    np.testing.assert_allclose(rigid3.interpolate(first, last, 0.0), first, atol=1e-12)
    np.testing.assert_allclose(rigid3.interpolate(first, last, np.ones(5)), last, atol=1e-12)


@given(poses, poses, vectors)
def test_a_pose_as_a_value_does_what_the_functions_do(a, b, x):
    left, right = Rigid3(a), Rigid3(b)
    np.testing.assert_allclose(left @ right, rigid3.compose(a, b), atol=1e-12)
    np.testing.assert_allclose(left @ x, rigid3.apply(a, x), atol=1e-12)
    np.testing.assert_allclose(left.inverse() @ (left @ x), x, atol=1e-12)
    np.testing.assert_allclose((left.matrix @ [*x, 1.0])[:3], left @ x, atol=1e-12)
    np.testing.assert_allclose(left @ left.center, 0.0, atol=1e-12)
    for same in (
        Rigid3.from_matrix(left.rotation, left.translation),
        Rigid3.from_matrix(left.matrix),
        Rigid3.from_matrix(left.matrix[:3]),
    ):
        np.testing.assert_allclose(same.matrix, left.matrix, atol=1e-12)
    assert Rigid3(left) == left
    assert hash(Rigid3(left)) == hash(left)


def test_a_pose_as_a_value_keeps_its_bits_and_cannot_be_changed():
    given_pose = rigid3.from_matrix(rigid3.exp_so3([0.1, 0.2, 0.3]), [1.0, 2.0, 3.0])
    pose = Rigid3(given_pose)
    assert np.asarray(pose).tobytes() == given_pose.tobytes()
    with pytest.raises(ValueError, match="read-only"):
        pose.translation[0] = 0.0
    assert np.asarray(Rigid3([0, 0, 0, 2, 1, 1, 1])).tolist() == [0, 0, 0, 1, 1, 1, 1]
    np.testing.assert_allclose(Rigid3.identity() @ pose, pose, atol=1e-15)


@pytest.mark.parametrize(
    "wrong", [np.zeros(7), np.ones(6), [np.nan, 0, 0, 1, 0, 0, 0], [0, 0, 0, 1, 0, 0, np.inf], np.ones((1, 7))]
)
def test_what_is_no_pose_is_refused(wrong):
    with pytest.raises(InputError, match="pose"):
        Rigid3(wrong)


@pytest.mark.parametrize("wrong", [2 * np.eye(3), np.diag([1.0, 1.0, -1.0]), np.eye(2), np.full((3, 3), np.nan)])
def test_what_is_no_rotation_is_refused(wrong):
    with pytest.raises(InputError, match="pose"):
        Rigid3.from_matrix(wrong, np.zeros(3))
