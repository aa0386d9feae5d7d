"""Laws of the density of a moved thing's new pose."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmap_gtsam.frontend.landing import landing_log_density
from factors.mixture import log_sum
from sequences import se3
from tests.ctmap_gtsam.scenes import config_of, level, model_of, shape_named, standing
from tests.factors.strategies import random_image

NAMES = ("mug", "cereal_box", "bowl", "toilet_roll", "apple")
"""no symmetry, half-turns about each axis, an axis, an axis with ends that look alike, an axis again"""
MODEL = model_of(*NAMES)
ROUGH = model_of(*NAMES, config=config_of("prediction.landing_tilt_rad=0.5", "context.support_sigma_m=0.05"))
"""a density so wide that Monte Carlo meets it everywhere"""
SURFACES = (level(0.0), level(1.2, half=0.4))
SEEDS = st.integers(0, 2**31)


def about(shape, plane, half, rng, n, reach=0.28):
    """Poses (n, 4, 4) turned anyhow, the centre above or below the plane, the lowest point within its reach."""
    R = se3.uniform_rotations(rng.random((n, 3)))
    low = (R[:, 2] @ shape.hull_points.T).min(axis=-1)
    xy = rng.uniform(-half, half, (n, 2))
    return se3.make(R, np.column_stack([xy, plane.offset + rng.uniform(-reach, reach, n) - low]))


@pytest.mark.parametrize("name", NAMES)
def test_it_integrates_to_one(name):
    """On the surfaces as much as the other part leaves, which is one over the neighbourhood by itself."""
    shape, rng, n = shape_named(ROUGH, name), np.random.default_rng(0), 10000
    unseen = ROUGH.config.context.other_support
    total = 0.0
    for plane, half in zip(SURFACES, (0.6, 0.4), strict=True):
        T = about(shape, plane, half, rng, n)
        landed = np.exp(landing_log_density(ROUGH, shape, T, SURFACES)) - unseen * np.exp(ROUGH.log_uniform(shape))
        volume = (2 * half) ** 2 * 0.56 * np.exp(shape.symmetry.log_quotient_rotations)
        total += float(landed.mean()) * volume
    assert total == pytest.approx(1.0 - unseen, rel=0.06)
    ball = 4.0 / 3.0 * np.pi * ROUGH.config.prediction.region_radius_m**3
    rotations = np.exp(shape.symmetry.log_quotient_rotations)
    assert np.exp(ROUGH.log_uniform(shape)) * ball * rotations == pytest.approx(1.0)


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=5)
@given(SEEDS)
def test_it_is_the_same_for_poses_that_look_the_same(name, seed):
    """As far as the coarse mesh has the symmetries of the fine one: a millimetre of its height."""
    shape, rng = shape_named(ROUGH, name), np.random.default_rng(seed)
    T = about(shape, SURFACES[0], 0.5, rng, 20, reach=0.05)
    images = np.stack([pose @ random_image(rng, shape.symmetry) for pose in T])
    a, b = (landing_log_density(ROUGH, shape, poses, SURFACES) for poses in (T, images))
    np.testing.assert_allclose(a, b, atol=0.1)


@settings(max_examples=10)
@given(SEEDS, st.sampled_from(NAMES))
def test_it_moves_with_the_world(seed, name):
    shape, rng = shape_named(MODEL, name), np.random.default_rng(seed)
    world = se3.exp(rng.normal(size=6))
    T = np.concatenate([about(shape, SURFACES[0], 0.7, rng, 10, 0.03), standing(shape, 0.1, 0.2)[None]])
    A = rng.normal(size=(len(T), 6, 6)) * 0.01
    covariance = A @ np.swapaxes(A, -1, -2)
    here = landing_log_density(MODEL, shape, T, SURFACES, covariance)
    there = landing_log_density(MODEL, shape, world @ T, tuple(s.moved(world) for s in SURFACES), covariance)
    np.testing.assert_allclose(here, there, atol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_what_stands_on_a_surface_is_likelier_there_than_anywhere_and_what_floats_leans_or_is_beside_it_is_not(name):
    shape = shape_named(MODEL, name)
    upright = standing(shape, 0.2, 0.1, 1.0)
    poses = [upright for _ in range(4)]
    poses[1] = se3.make(np.eye(3), np.array([0.0, 0.0, 0.15])) @ upright
    poses[2] = se3.make(np.eye(3), np.array([0.7, 0.0, 0.0])) @ upright
    poses[3] = standing(shape, 0.2, 0.1) @ se3.make(se3.so3_exp(np.array([0.7, 0.1, 0.0])), np.zeros(3))
    gained = landing_log_density(MODEL, shape, np.stack(poses), SURFACES) - MODEL.log_uniform(shape)
    unseen = np.log(MODEL.config.context.other_support)
    assert gained[0] > 1.0
    np.testing.assert_allclose(gained[1:3], unseen, atol=1e-3)
    # a ball rests on any side
    assert gained[3] < gained[0] - 1.0 or name == "apple"


def test_where_no_surface_is_known_it_is_anywhere():
    shape = shape_named(MODEL, "mug")
    T = np.stack([standing(shape, 0.1, 0.1), se3.exp(np.arange(6.0))])
    np.testing.assert_array_equal(landing_log_density(MODEL, shape, T, ()), MODEL.log_uniform(shape))


@settings(max_examples=10)
@given(SEEDS, st.sampled_from(("mug", "cereal_box", "toilet_roll")))
def test_of_an_uncertain_pose_it_is_the_mean(seed, name):
    shape, rng = shape_named(MODEL, name), np.random.default_rng(seed)
    T = standing(shape, 0.1, 0.2, 0.5)
    T[2, 3] += rng.uniform(-0.01, 0.01)
    deviations = np.repeat([0.02, 0.006], 3)
    poses = se3.retract(T, rng.normal(size=(4000, 6)) * deviations)
    mean = log_sum(landing_log_density(MODEL, shape, poses, SURFACES)) - np.log(len(poses))
    averaged = landing_log_density(MODEL, shape, T[None], SURFACES, np.diag(deviations**2)[None])[0]
    assert averaged == pytest.approx(mean, abs=0.25)
