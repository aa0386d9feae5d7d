"""The compiled batches beside the plain definitions: the same to rounding."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factors.motions import retract
from factors.symmetry import Symmetry, distinct, near, residual
from sequences import se3
from tests.factors.strategies import SCALES, SEEDS, SYMMETRIES, random_image, random_pose, random_tangent

SHAPES = st.sampled_from([((), ()), ((), (5,)), ((4,), (4,)), ((3, 1, 1), (3, 2, 4)), ((3, 1), (4,)), ((2,), ())])


@settings(deadline=None)
@given(seed=SEEDS, scale=SCALES, shapes=SHAPES)
def test_a_compiled_step_is_the_plain_one(seed, scale, shapes):
    rng = np.random.default_rng(seed)
    T = se3.exp(rng.normal(size=(*shapes[0], 6)))
    xi = scale * rng.normal(size=(*shapes[1], 6))
    there = retract(T, xi)
    np.testing.assert_allclose(there, se3.retract(T, xi), rtol=0, atol=1e-13)
    assert there.shape == se3.retract(T, xi).shape


def test_no_step_leaves_a_pose_as_it_is():
    T = random_pose(np.random.default_rng(0))
    np.testing.assert_array_equal(retract(T, np.zeros((3, 6))), np.stack([T] * 3))


def by_angle(T_a, T_b, symmetry, rng):
    """The smallest angle between cosets by trying every symmetry and many free rotations: (n,)."""
    turns = np.linspace(-np.pi, np.pi, 721) if symmetry.free == 1 else np.zeros(1)
    spins = se3.so3_exp(turns[:, None] * symmetry.free_rotations[:, 0]) if symmetry.free == 1 else np.eye(3)[None]
    R = np.swapaxes(T_a[..., :3, :3], -1, -2) @ T_b[..., :3, :3]
    all_of_them = R[:, None, None] @ symmetry.discrete[:, None, :3, :3] @ spins
    return np.linalg.norm(se3.so3_log(all_of_them), axis=-1).min(axis=(1, 2))


@pytest.mark.parametrize("name", [n for n in SYMMETRIES if n != "ball"])
@settings(deadline=None, max_examples=25)
@given(seed=SEEDS)
def test_the_residual_has_the_smallest_angle_of_all_images(name, seed):
    rng, symmetry = np.random.default_rng(seed), SYMMETRIES[name]
    T_a, T_b = (np.stack([random_pose(rng) for _ in range(6)]) for _ in range(2))
    turned = np.linalg.norm(residual(T_a, T_b, symmetry)[:, :3], axis=-1)
    np.testing.assert_allclose(turned, by_angle(T_a, T_b, symmetry, rng), atol=0.005)


def scattered(rng, symmetry, n=30):
    """Poses about few places, each written in any of its equivalent poses."""
    places = [random_pose(rng) for _ in range(4)]
    steps = (random_tangent(rng, rng.choice([0.002, 0.02, 0.2])) for _ in range(n))
    return np.stack([places[rng.integers(4)] @ se3.exp(s) @ random_image(rng, symmetry) for s in steps])


def centred(symmetry):
    """The same symmetries about the origin, as shapes have them."""
    to, back = symmetry.T_object_centre, se3.inverse(symmetry.T_object_centre)
    return Symmetry(back @ symmetry.discrete @ to, symmetry.axes, np.zeros_like(symmetry.axes))


@pytest.mark.parametrize("name", SYMMETRIES)
@settings(deadline=None, max_examples=25)
@given(seed=SEEDS, about_origin=st.booleans())
def test_near_means_a_short_residual(name, seed, about_origin):
    symmetry = centred(SYMMETRIES[name]) if about_origin else SYMMETRIES[name]
    poses = scattered(np.random.default_rng(seed), symmetry)
    r = residual(poses[0], poses, symmetry)
    turned, moved = np.linalg.norm(r[:, :3], axis=-1), np.linalg.norm(r[:, 3:], axis=-1)
    for limits in ((0.1, 0.05), (0.3, np.inf), (np.inf, 0.1)):
        np.testing.assert_array_equal(
            near(poses[0], poses, symmetry, *limits), (turned < limits[0]) & (moved < limits[1])
        )


@pytest.mark.parametrize("name", SYMMETRIES)
@settings(deadline=None, max_examples=25)
@given(seed=SEEDS, most=st.integers(1, 40))
def test_distinct_rows_are_the_first_that_no_earlier_one_is_near(name, seed, most):
    rng, symmetry = np.random.default_rng(seed), SYMMETRIES[name]
    poses = scattered(rng, symmetry)
    order, apart = rng.permutation(len(poses)), (0.1, 0.05)
    kept = []
    for row in order:
        if len(kept) < most and not any(near(poses[k], poses[row], symmetry, *apart) for k in kept):
            kept.append(int(row))
    assert distinct(poses, order, most, symmetry, *apart) == kept
