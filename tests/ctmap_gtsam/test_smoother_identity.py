"""Laws of which objects are one over the whole run."""

from itertools import permutations
from types import SimpleNamespace

import numpy as np
import pytest

from ctmap_gtsam.frontend.proposer import PoseModes
from ctmap_gtsam.smoothing.belief import judge
from ctmap_gtsam.smoothing.identity import duplicates, join_moved, merge_duplicates
from ctmap_gtsam.smoothing.modes import Sighting
from sequences import se3
from sequences.types import Detection, LocalisationNoise
from tests.ctmap_gtsam.scenes import model_of

MODEL = model_of("mug")
HERE, THERE = (se3.make(np.eye(3), np.array([x, 0.0, 0.8])) for x in (0.0, 0.6))
DAY = 86400.0
BOX = Detection((10.0, 10.0, 40.0, 40.0), np.array([0.1, 0.9]))
SEEN, EMPTY = 60.0, -40.0
"""log-likelihoods of a pose where the thing is, and where it should show and doesn't"""
RECORDING = SimpleNamespace(
    keyframes=np.arange(8),
    run=SimpleNamespace(
        frames=[SimpleNamespace(visit=k // 4) for k in range(8)], localisation=LocalisationNoise(1e-4, 1e-4)
    ),
    T_world_camera=lambda k: np.eye(4),
    time_s=lambda k: (k // 4) * DAY + k,
)
"""two visits of four keyframes, a day apart"""


def thing(object_id, *looks):
    """An object of looks: keyframe, pose, nats; it has a box where it is seen."""
    covariance = np.diag(np.repeat([1e-4, 1e-6], 3))[None]

    def sighting(k, T, nats):
        value = np.array([nats])
        modes = PoseModes(T[None], value, value, covariance, np.array([2.0 if nats > 0 else -2.0]))
        return Sighting(k, (modes,), (np.zeros(1),), 0.0)

    boxes = {k: BOX for k, _, nats in looks if nats > 0}
    return judge(object_id, boxes, {k: sighting(k, T, nats) for k, T, nats in looks}, RECORDING, MODEL)


def stays(object_id, T, keyframes, nats=SEEN):
    return thing(object_id, *((k, T, nats) for k in keyframes))


def test_of_two_in_one_place_the_one_with_more_evidence_stays_in_any_order():
    more, less, other = stays(3, HERE, range(8)), stays(1, HERE, range(3)), stays(2, THERE, range(8))
    for order in permutations((more, less, other)):
        things = {t.object_id: t for t in order}
        assert duplicates(things, MODEL) == {1: 3}
        assert sorted(merge_duplicates(things, RECORDING, MODEL)) == [2, 3]


def test_what_are_in_one_place_at_different_times_are_two():
    first, second = stays(1, HERE, range(4)), stays(2, HERE, range(4, 8))
    assert duplicates({1: first, 2: second}, MODEL) == {}


@pytest.fixture
def moved():
    """A mug that was moved, was begun anew at its new place, and was found to be the old one in the end."""
    old = thing(1, *((k, HERE, SEEN) for k in range(4)), (4, HERE, EMPTY), (5, HERE, EMPTY), (7, THERE, SEEN))
    return {1: old, 2: stays(2, THERE, (4, 5, 6, 7))}


def test_of_a_duplicate_its_life_elsewhere_is_kept_whichever_has_more_evidence(moved):
    assert duplicates(moved, MODEL) == {2: 1}
    parts = merge_duplicates(moved, RECORDING, MODEL)
    assert parts[1].keyframes == (0, 1, 2, 3, 4, 5)
    assert sorted(parts[1].boxes) == [0, 1, 2, 3]
    assert parts[2] is moved[2]


def test_and_is_joined_to_what_it_became(moved):
    joined = join_moved(merge_duplicates(moved, RECORDING, MODEL), RECORDING, MODEL)
    assert sorted(joined) == [1]
    assert joined[1].keyframes == tuple(range(8))
    assert sorted(joined[1].boxes) == list(range(8))
    assert joined[1].posteriors[0].moved[3] > 0.99
    assert (np.delete(joined[1].posteriors[0].moved, 3) < 0.01).all()
