"""Laws of the filter over a run: each keyframe sees only the past, and what is there is found."""

from dataclasses import replace

import numpy as np
import pytest

from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.filtering.filter import filter_run
from ctmap_gtsam.model import Model
from factors.symmetry import Symmetry, residual
from sequences.types import LocalisationNoise
from tests.ctmap_gtsam.scenes import CHEAP, assert_begins_with, assert_the_seed_decides, config_of, cut, small_run

CONFIG = config_of(*CHEAP, "filter.search_every=2")


@pytest.fixture(scope="module")
def scene():
    return small_run()


@pytest.fixture(scope="module")
def estimate(scene) -> Estimate:
    return filter_run(scene[0], CONFIG)


@pytest.mark.parametrize("n", [1, 3, 5])
def test_the_first_keyframes_are_those_of_a_run_cut_after_them(scene, estimate, n):
    """Law 2 of the model, for the filter."""
    assert_begins_with(estimate, filter_run(cut(scene[0], n), CONFIG))


def test_nothing_is_said_of_a_thing_before_its_track_has_started(estimate):
    started = CONFIG.frontend.start_after - 1
    assert (estimate.existence[:, :started] == 0.0).all()
    assert (estimate.best_mode[:, :started] == -1).all()
    assert (estimate.best_mode[:, started:] >= 0).all()
    np.testing.assert_allclose(estimate.class_probability.sum(-1), 1.0)
    np.testing.assert_allclose(estimate.class_probability[:, :started], 1.0 / len(estimate.class_ids))


def test_what_stands_there_is_found(scene):
    run, truth = scene
    estimate = filter_run(run)
    assert len(estimate.object_id) == len(truth)
    for name, T in truth.items():
        source = next(c for c in run.catalogue.classes if c.name == name)
        row = int(np.argmin(np.linalg.norm(estimate.pose[:, -1, :3, 3] - T[:3, 3], axis=-1)))
        assert estimate.best_class[row, -1] == source.obj_id
        assert estimate.existence[row, -1] > 0.9
        r = residual(estimate.pose[row, -1], T, Symmetry.of(source))
        assert np.linalg.norm(r[3:]) < 0.006
        assert estimate.in_view[row, -1]


def test_mixtures_are_normalised_and_covariances_proper(estimate):
    m = estimate.modes
    for row in range(len(estimate.object_id)):
        for k in range(len(estimate.keyframe_frame)):
            for c in np.unique(m.class_id):
                own = (m.object == row) & (m.keyframe == k) & (m.class_id == c)
                assert np.exp(m.log_weight[own]).sum() <= 1.0 + 1e-9
    assert (np.linalg.eigvalsh(m.covariance)[:, 0] > 0).all()
    assert np.isfinite(m.T_world_object).all()


def test_no_pose_is_surer_than_the_camera_that_saw_it(scene):
    """More views of a camera that may be elsewhere say no more of where a thing is in the world."""
    noise = LocalisationNoise(rotation_rad=0.01, translation_m=0.02)
    estimate = filter_run(replace(scene[0], localisation=noise), CONFIG)
    away = np.linalg.norm(scene[0].frames[0].T_world_camera[:3, 3])
    model = Model(scene[0].catalogue, CONFIG)
    least = np.min([model.shared_variance(shape, noise, 0.8 * away) for shape in model.shapes], axis=0)
    assert (estimate.modes.covariance[:, range(6), range(6)] > least).all()


def test_it_says_how_it_did_at_each_keyframe(estimate):
    told = estimate.meta["diagnostics"]
    n, k = estimate.existence.shape
    started = CONFIG.frontend.start_after - 1
    assert told["hypotheses_scored"] == sum(told["keyframes"]["hypotheses_scored"])
    by_object = np.array(told["objects"]["hypotheses_scored"])
    assert by_object.shape == (n, k)
    np.testing.assert_array_equal(by_object.sum(axis=0), told["keyframes"]["hypotheses_scored"])
    assert (by_object[:, :started] == 0).all()
    effective = np.array(told["objects"]["effective_sample_size"], dtype=float)
    entropy = np.array(told["objects"]["class_entropy"], dtype=float)
    for table in (effective, entropy):
        np.testing.assert_array_equal(np.isnan(table), ~estimate.in_view)
    seen = estimate.in_view
    assert (effective[seen] >= 1.0).all()
    assert (effective[seen] <= CONFIG.filter.particles).all()
    p = np.maximum(estimate.class_probability, 1e-300)
    np.testing.assert_allclose(entropy[seen], -(p * np.log(p)).sum(-1)[seen], rtol=1e-3, atol=1e-6)


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(scene, tmp_path):
    assert_the_seed_decides(lambda seed: filter_run(scene[0], replace(CONFIG, seed=seed)), tmp_path)


def test_a_thing_that_was_taken_away_is_missed():
    """Its place is seen empty, however long it had been seen there."""
    for last in (4, 9):
        run, truth = small_run(frames=last + 3, there=lambda k, name, last=last: name != "mug" or k <= last)
        estimate = filter_run(run, CONFIG)
        mug = int(np.argmin(np.linalg.norm(estimate.pose[:, last, :3, 3] - truth["mug"][:3, 3], axis=-1)))
        assert estimate.existence[mug, last] > 0.9
        assert (estimate.existence[mug, last + 1 :] < 0.5).all()
        assert estimate.existence[1 - mug, -1] > 0.9


def test_a_thing_that_the_detector_misses_is_doubted_and_back_when_it_is_found_again():
    """Its class and pose stay, with a belief: depth can't tell it from what looks alike, and the detector says no."""
    run, truth = small_run(frames=14, seen=lambda k, name: name != "mug" or not 4 <= k < 8)
    estimate = filter_run(run, CONFIG)
    mug = int(np.argmin(np.linalg.norm(estimate.pose[:, 3, :3, 3] - truth["mug"][:3, 3], axis=-1)))
    assert estimate.existence[mug, 3] > 0.8
    assert estimate.existence[mug, 7] < estimate.existence[mug, 3]
    assert estimate.existence[mug, -1] > 0.5
    assert (estimate.best_class[mug, 4:] == run.catalogue.classes[2].obj_id).all()
    assert np.linalg.norm(estimate.pose[mug, 4:, :3, 3] - estimate.pose[mug, 3, :3, 3], axis=-1).max() < 0.005


def test_an_hour_unseen_leaves_room_for_a_move_and_seeing_it_again_none():
    run, truth = small_run(frames=4, visits=2)
    estimate = filter_run(run, CONFIG)
    assert len(estimate.object_id) == len(truth)
    assert (estimate.existence[:, -1] > 0.9).all()


def test_without_boxes_there_is_nothing():
    run, _ = small_run(frames=3, seen=lambda k, name: False)
    estimate = filter_run(run, CONFIG)
    assert len(estimate.object_id) == 0
    assert estimate.T_world_camera.shape == (3, 4, 4)


def test_t_map_says_nothing_of_context(scene):
    estimate = filter_run(scene[0], CONFIG, context=False)
    assert estimate.meta["method"] == "filter-t"
    context = estimate.meta["potentials"].index("context")
    np.testing.assert_allclose(estimate.ledger.nats[estimate.ledger.potential == context], 0.0, atol=1e-9)
