"""Laws of the views that the filter keeps, and of poses that are found late."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmap_gtsam.filtering.belief import ClassBelief
from ctmap_gtsam.filtering.memory import Memory
from ctmap_gtsam.filtering.particles import Particles
from ctmap_gtsam.filtering.updating import Updater
from ctmap_gtsam.frontend.association import Track
from ctmap_gtsam.frontend.proposer import Proposer
from ctmap_gtsam.frontend.surroundings import Surroundings
from sequences import se3
from sequences.types import LocalisationNoise
from tests.ctmap_gtsam.scenes import CHEAP, config_of, looking, model_of, shape_named, standing, view_of

CONFIG = config_of(*CHEAP, "filter.search_every=1", "filter.search_share=1.0")
MODEL = model_of("mug", "soup_can", "cereal_box", config=CONFIG)
MUG = shape_named(MODEL, "mug")
TRUTH = standing(MUG, 0.0, 0.0, 0.5)
ALONE = Surroundings((), ())


def seen(k):
    return view_of(MODEL, [(MUG, TRUTH)], looking(0.15 * k - 0.3, 0.7, 0.7), k)


def looked_at(proposer, k):
    observation = seen(k)
    detection = observation.frame.detections[0]
    return proposer.view(observation, np.array(detection.box), detection, ALONE), observation.frame.T_camera_world


@settings(max_examples=20, deadline=None)
@given(st.lists(st.floats(0.01, 1.0), min_size=1, max_size=40))
def test_the_views_that_are_kept_stand_for_all(shares):
    view, T = looked_at(Proposer(MODEL), 0)
    memory = Memory()
    for share in shares:
        memory = memory.joined(replace(view, share=share), T)
    assert sum(v.share for v, _ in memory.views) + memory.pending == pytest.approx(sum(shares))
    assert len(memory.views) <= 10


def test_the_true_pose_explains_all_views_and_one_elsewhere_none():
    proposer, memory = Proposer(MODEL), Memory()
    for k in range(4):
        memory = memory.joined(*looked_at(proposer, k))
    reach = np.array([0.02, 0.01])
    true = memory.log_likelihood(proposer, MUG, TRUTH, reach)
    assert true > 50.0
    elsewhere = TRUTH.copy()
    elsewhere[:3, 3] += [0.05, 0.03, 0.0]
    assert memory.log_likelihood(proposer, MUG, elsewhere, reach) < 0.5 * true
    # an error of the localisation is forgiven, as far as it goes
    beside = TRUTH.copy()
    beside[:3, 3] += [0.006, 0.0, 0.0]
    forgiven = memory.log_likelihood(proposer, MUG, beside, reach)
    assert forgiven > memory.log_likelihood(proposer, MUG, beside, np.zeros(2))
    assert Memory().log_likelihood(proposer, MUG, TRUTH, reach) == 0.0


def mug_lost(model):
    """An updater, and a belief whose particles of the mug, which it is, are all in a wrong place."""
    updater = Updater(model, Proposer(model), LocalisationNoise())
    first = seen(0)
    track = Track(0, (0,), (first.frame.detections[0],), 0)
    found = tuple(updater.search(track, shape, first, ALONE) for shape in updater.model.shapes)
    belief = updater.start(track, first, ALONE, found)
    assert np.argmax(belief.class_log_evidence(model)) == MUG.index
    far_off = se3.make(TRUTH[:3, :3], TRUTH[:3, 3] + [0.0, 0.0, 0.08])
    lost = ClassBelief(Particles(np.tile(far_off, (24, 1, 1)), np.full(24, -np.log(24.0))), -200.0)
    classes = tuple(lost if c == MUG.index else own for c, own in enumerate(belief.classes))
    # a class so far behind sleeps most of the time
    return updater, replace(belief, classes=classes, steps=14, searched=13, returned=14)


def after(updater, belief, score):
    """The belief after four views more, in which the detector gives the mug a score."""
    for k in range(1, 5):
        observation = seen(k)
        scores = np.full(4, (1.0 - score) / 3.0)
        scores[1 + MUG.index] = score
        detection = replace(observation.frame.detections[0], class_scores=scores)
        belief = updater.step(belief, detection, observation, ALONE)
    return belief


def test_a_class_that_was_not_found_at_first_is_believed_once_it_is():
    """Its evidence is that of all views, not of those since it was found."""
    updater, belief = mug_lost(MODEL)
    assert np.argmax(belief.class_log_evidence(MODEL)) != MUG.index
    belief = after(updater, belief, 0.8)
    assert np.argmax(belief.class_log_evidence(MODEL)) == MUG.index
    own = belief.classes[MUG.index]
    assert np.linalg.norm(own.particles.best(1)[0, :3, 3] - TRUTH[:3, 3]) < 0.01


def test_searches_are_ever_further_apart_until_an_absence_ends():
    updater = Updater(MODEL, Proposer(MODEL), LocalisationNoise())
    belief, first = mug_lost(MODEL)[1], seen(0)
    every = MODEL.config.filter.search_every

    def ages(returned, views):
        """Views since then at which it is searched for; all have boxes."""
        now, out = replace(belief, steps=returned, searched=returned, returned=returned), []
        for _ in range(views):
            now = replace(now, steps=now.steps + 1)
            if updater.searches(now, first.frame.detections[0]):
                out.append(now.steps - returned)
                now = replace(now, searched=now.steps)
        return out

    assert ages(1, 40 * every) == [every * 2**n for n in range(6)]
    assert ages(77, 40 * every) == ages(1, 40 * every)
    assert not updater.searches(replace(belief, steps=10**6), None)


def test_what_the_detector_names_is_searched_for_without_waiting_and_what_it_does_not_is_not():
    seldom = model_of("mug", "soup_can", "cereal_box", config=config_of(*CHEAP, "filter.search_every=1000"))
    updater, belief = mug_lost(seldom)
    assert np.argmax(after(updater, belief, 0.8).class_log_evidence(seldom)) == MUG.index
    # one that was named another thing so far
    others = replace(belief, score_sum=np.where(np.arange(3) == MUG.index, -50.0, 0.0))
    assert np.argmax(after(updater, others, 0.1).class_log_evidence(seldom)) != MUG.index


def test_what_explains_less_than_clutter_would_is_searched_for_in_every_view():
    seldom = model_of("mug", "soup_can", "cereal_box", config=config_of(*CHEAP, "filter.search_every=1000"))
    updater, belief = mug_lost(seldom)
    alone = replace(belief, classes=tuple(own if c == MUG.index else None for c, own in enumerate(belief.classes)))
    evidence, scored = alone.classes[MUG.index].log_evidence, []
    for clutter in (evidence - 1e6, evidence + 1e6):
        before = updater.proposer.hypotheses_scored
        after(updater, replace(alone, log_clutter=clutter), 0.8)
        scored.append(updater.proposer.hypotheses_scored - before)
    searches = 4 * seldom.config.frontend.fresh_poses
    assert scored[1] > scored[0] + searches
