"""Laws of what the smoother's searches find."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmap_gtsam.smoothing.modes import Found
from factors.symmetry import residual
from sequences import se3
from tests.ctmap_gtsam.scenes import model_of, shape_named, standing

MODEL = model_of("mug", "soup_can")


def nothing_found():
    empty = {s.index: np.zeros((0, 4, 4)) for s in MODEL.shapes}
    return Found(empty, {s.index: np.zeros(0) for s in MODEL.shapes}, np.zeros(len(MODEL.shapes)))


@settings(max_examples=25, deadline=None)
@given(st.sampled_from(["mug", "soup_can"]), st.integers(0, 2**16))
def test_what_is_found_in_several_views_is_kept_once_and_the_best_first(name, seed):
    rng, shape, found = np.random.default_rng(seed), shape_named(MODEL, name), nothing_found()
    places = [standing(shape, 0.2 * k, 0.0, 0.5 * k) for k in range(3)]
    best = -np.inf
    for _ in range(5):
        noise = rng.normal(size=(3, 6)) * np.repeat([0.01, 0.001], 3)
        scores = rng.uniform(0.0, 50.0, 3)
        best = max(best, scores.max())
        found.join(shape, se3.retract(np.stack(places), noise), scores)
    poses, scores = found.poses[shape.index], found.scores[shape.index]
    assert len(poses) == len(places)
    assert scores[0] == best
    assert (np.diff(scores) <= 0.0).all()
    for k, place in enumerate(places):
        r = residual(poses, place, shape.symmetry)
        assert (np.linalg.norm(r[:, 3:], axis=-1) < 0.01).sum() == 1, k


def test_no_more_than_a_few_are_started_from():
    shape, found = shape_named(MODEL, "mug"), nothing_found()
    poses = np.stack([standing(shape, 0.1 * k) for k in range(20)])
    found.join(shape, poses, np.arange(20.0))
    assert 4 <= len(found.poses[shape.index]) < 20
    np.testing.assert_array_equal(found.poses[shape.index][0], poses[-1])
