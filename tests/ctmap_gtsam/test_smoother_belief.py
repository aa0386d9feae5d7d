"""What a smoothed object says between its views, and what of it a round needs to start from."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctmap_gtsam.filtering.belief import ClassBelief
from ctmap_gtsam.filtering.particles import Particles
from ctmap_gtsam.frontend.proposer import PoseModes
from ctmap_gtsam.smoothing.belief import judge
from ctmap_gtsam.smoothing.modes import Sighting
from ctmap_gtsam.smoothing.rounds import wanted_of
from factors.symmetry import near
from sequences import se3
from sequences.types import Detection
from tests.ctmap_gtsam.beliefs import belief_of
from tests.ctmap_gtsam.scenes import model_of
from tests.ctmap_gtsam.things import EMPTY, HERE, MODEL, RECORDING, SEEN, THERE, stays, thing

MUG = MODEL.shapes[0]


def moved(keyframes=(0, 2, 3, 5, 6)):
    """A mug that stood here and then there, and isn't measured in every view."""
    looks = [(k, HERE if k < 4 else THERE, SEEN if k != 3 else EMPTY) for k in keyframes]
    return thing(0, *looks)


def numbers(owner):
    """Bytes of all that is held of the views."""
    arrays = [a for stages in owner.stages.values() for s in stages for a in (s.T_world_centre, s.covariance)]
    modes = [m for s in owner.sightings.values() for m in s.modes if m is not None]
    return sum(a.nbytes for a in arrays) + sum(m.numbers.nbytes for m in modes)


@given(st.sets(st.integers(0, 7), min_size=1), st.integers(-2, 10))
def test_a_pose_is_that_of_the_nearest_keyframe_the_earlier_of_two_and_held_from_the_last(keyframes, asked):
    poses = {k: (np.diag([1.0, 1.0, 1.0, k]), np.eye(6)) for k in keyframes}
    owner = thing(0, *((k, HERE, SEEN) for k in range(8))).with_poses(poses)
    nearest = min(sorted(keyframes), key=lambda k: (abs(k - asked), k))
    assert owner.pose_near(owner.best_class, asked)[0, 3, 3] == nearest
    assert owner.held(asked).T_world_centre[3, 3] == max((k for k in keyframes if k <= asked), default=min(keyframes))


@given(st.integers(0, 7))
def test_what_a_round_starts_from_says_the_same_of_poses_and_classes(keyframe):
    whole = moved()
    start = whole.to_start_from()
    for c in range(len(MODEL.shapes)):
        np.testing.assert_array_equal(start.pose_near(c, keyframe), whole.pose_near(c, keyframe))
        np.testing.assert_array_equal(start.modes_at(c, keyframe), whole.modes_at(c, keyframe))
        assert len(whole.modes_at(c, keyframe)) == (keyframe in whole.keyframes)
    assert start.presence_at(keyframe) == whole.presence_at(keyframe)
    assert (start.exists, start.possible(MODEL), start.likely()) == (
        whole.exists,
        whole.possible(MODEL),
        whole.likely(),
    )
    assert start.keyframes == whole.keyframes


def test_and_holds_of_a_mode_its_pose_alone():
    whole = moved()
    modes = sum(len(s.T_world_centre) for stages in whole.stages.values() for s in stages)
    assert numbers(whole.to_start_from()) == modes * 16 * 8
    assert numbers(whole) > 5 * numbers(whole.to_start_from())


@pytest.mark.parametrize(("behind", "named"), [(0.01, True), (0.5, False)])
def test_between_classes_that_explain_as_much_but_for_their_meshes_error_the_detector_decides(behind, named):
    """However many views there are; filter and smoother weigh classes alike (`Model.between_classes`)."""
    model = model_of("mug", "cereal_box")
    views = {k: nats * np.array([1.0, 1.0 - behind]) for k, nats in enumerate(np.linspace(50.0, 400.0, 8))}
    boxes = {k: Detection((10.0, 10.0, 40.0, 40.0), np.array([0.02, 0.03, 0.95])) for k in views}
    covariance = np.diag(np.repeat([1e-4, 1e-6], 3))[None]

    def modes(nats):
        return PoseModes.of(HERE[None], np.array([nats]), np.array([nats]), covariance, np.array([2.0]))

    sightings = {k: Sighting(k, tuple(map(modes, nats)), (np.zeros(1),) * 2, 0.0) for k, nats in views.items()}
    assert (judge(0, boxes, sightings, RECORDING, model).best_class == 1) == named
    explained = sum(views.values())
    particles = Particles(HERE[None], np.zeros(1))
    classes = tuple(ClassBelief(particles, float(nats)) for nats in explained)
    scores = np.sum([model.class_scores(box) for box in boxes.values()], axis=0)
    filtered = belief_of(classes, score_sum=scores, steps=8)
    assert (np.argmax(filtered.class_log_evidence(model)) == 1) == named


def test_a_place_is_claimed_by_what_is_seen_there_in_that_visit():
    """However much other visits, and other places in the same visit, say for another thing."""
    strong = thing(
        1, *((k, T, nats * SEEN) for k, (T, nats) in enumerate([(HERE, 9)] * 2 + [(THERE, 1)] + [(THERE, 9)] * 5))
    )
    weak = stays(0, THERE, range(4))
    assert strong.log_evidence > weak.log_evidence
    own = [strong.claim_at(k) / SEEN for k in range(8)]
    assert own == pytest.approx([18.0] * 2 + [10.0] * 2 + [36.0] * 4)
    lone = thing(1, (0, HERE, 9 * SEEN), (2, THERE, SEEN), *((k, THERE, 9 * SEEN) for k in range(4, 8)))
    assert lone.claim_at(2) < weak.claim_at(2) == pytest.approx(4 * SEEN)


def test_a_view_tries_the_way_round_that_those_beside_it_take():
    """And no more of what it has tried: neither the same way nor what is far off in time."""
    turned = HERE @ se3.exp(np.array([0.0, np.pi / 2, 0.0, 0.0, 0.0, 0.0]))
    both = np.stack([HERE, turned])
    mug = thing(0, (0, HERE, SEEN), (1, both, [SEEN, SEEN]), (2, HERE, SEEN), (3, HERE, SEEN))
    tried = [wanted_of(mug, k, MODEL, lambda c, k=k: mug.modes_at(c, k)).starts[0] for k in range(4)]
    there = [bool(near(turned, starts, MUG.symmetry, 0.1, 0.01).any()) for starts in tried]
    assert there == [True, True, True, False]
    assert [len(starts) for starts in tried] == [3, 3, 3, 2]
