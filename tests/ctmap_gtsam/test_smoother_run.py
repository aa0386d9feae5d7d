"""Laws of the smoother over a run: what is there is found, from what any frame knows, and the sums are right."""

from dataclasses import replace

import numpy as np
import pytest

from ctmap_gtsam.config import Config
from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.filtering.filter import filter_run
from ctmap_gtsam.smoothing.smoother import smooth_run
from factors.symmetry import Symmetry, residual
from tests.ctmap_gtsam.scenes import CHEAP, config_of, small_run

CONFIG = config_of(*CHEAP)


def smoothed(run, config=None, context=True) -> Estimate:
    """The smoother after the filter that it begins with."""
    return smooth_run(run, filter_run(run, config, context=context), config)


def row_of(estimate, truth, name, k=-1):
    """The object that is nearest to a true thing at a keyframe."""
    return int(np.nanargmin(np.linalg.norm(estimate.pose[:, k, :3, 3] - truth[name][:3, 3], axis=-1)))


@pytest.fixture(scope="module")
def scene():
    return small_run()


@pytest.fixture(scope="module")
def estimate(scene) -> Estimate:
    return smoothed(scene[0], CONFIG)


def test_what_stands_there_is_found_at_every_keyframe(scene):
    run, truth = scene
    estimate = smoothed(run)
    assert len(estimate.object_id) == len(truth)
    for name, T in truth.items():
        source = next(c for c in run.catalogue.classes if c.name == name)
        row = row_of(estimate, truth, name)
        assert (estimate.best_class[row] == source.obj_id).all()
        assert (estimate.existence[row] > 0.9).all()
        assert estimate.in_view[row].all()
        r = residual(estimate.pose[row], T, Symmetry.of(source))
        assert np.linalg.norm(r[:, 3:], axis=-1).max() < 0.003


def test_the_same_seed_gives_the_same_bytes(scene, estimate, tmp_path):
    for name, some in (("a", estimate), ("b", smoothed(scene[0], CONFIG))):
        some.save(tmp_path / f"{name}.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_the_solver_ended_well_and_tells_its_energies(estimate):
    told = estimate.meta["diagnostics"]
    assert told["solver"]["end"] == "converged"
    trace = told["solver"]["trace"]
    assert (np.diff(trace) <= 0).all()
    assert len(told["energy_by_round"]) == told["rounds"] >= 2
    assert sum(told["energy_by_round"][-1].values()) == pytest.approx(trace[-1], abs=1e-9)
    assert told["energy_by_round"][-1].keys() == told["factors"].keys()
    assert told["hypotheses_scored"] > 100


def test_mixtures_are_normalised_and_covariances_proper(estimate):
    m = estimate.modes
    np.testing.assert_allclose(estimate.class_probability.sum(-1), 1.0)
    assert ((estimate.existence >= 0) & (estimate.existence <= 1)).all()
    assert (np.linalg.eigvalsh(m.covariance)[:, 0] > 0).all()
    assert (m.log_weight <= 1e-9).all()
    for row in range(len(estimate.object_id)):
        for k in range(len(estimate.keyframe_frame)):
            for c in np.unique(m.class_id):
                own = (m.object == row) & (m.keyframe == k) & (m.class_id == c)
                weight = np.exp(m.log_weight[own]).sum()
                assert weight <= 1.0 + 1e-6
                if own.any() and c == estimate.best_class[row, k]:
                    assert weight > 0.98  # but for modes that are too unlikely to be written


def test_a_belief_holds_that_it_may_be_none_of_its_poses(estimate):
    """In all that is reported of a pose is the chance that all views got it wrong, and it is never the pose."""
    m = estimate.modes
    wide = np.linalg.eigvalsh(m.covariance[:, :3, :3])[:, 0] > 1.0
    np.testing.assert_allclose(np.exp(m.log_weight[wide]), Config().smoother.unmeasured, rtol=1e-6)
    pairs = {(int(i), int(k)) for i, k in zip(m.object, m.keyframe, strict=True)}
    assert {(int(i), int(k)) for i, k in zip(m.object[wide], m.keyframe[wide], strict=True)} == pairs
    assert not wide[estimate.best_mode[estimate.best_mode >= 0]].any()


def test_what_was_taken_away_was_there_before_and_not_after():
    run, truth = small_run(frames=8, there=lambda k, name: name != "mug" or k < 4)
    estimate = smoothed(run, CONFIG)
    mug, can = row_of(estimate, truth, "mug", 0), row_of(estimate, truth, "soup_can", 0)
    assert (estimate.existence[mug, :4] > 0.9).all()
    assert (estimate.existence[mug, 5:] < 0.5).all()
    assert (estimate.existence[can] > 0.9).all()


def test_a_thing_is_known_from_the_frames_that_found_it_where_the_detector_missed_it():
    """Hindsight: the detector finds the mug from the third frame on, the smoother has it in the first."""
    run, truth = small_run(frames=7, seen=lambda k, name: name != "mug" or k > 1)
    estimate = smoothed(run, CONFIG)
    mug = row_of(estimate, truth, "mug")
    assert (estimate.existence[mug] > 0.9).all()
    assert np.linalg.norm(np.ptp(estimate.pose[mug, :, :3, 3], axis=0)) < 0.005


def test_a_thing_that_was_not_moved_between_visits_is_one_object():
    run, truth = small_run(frames=4, visits=2)
    estimate = smoothed(run, CONFIG)
    assert len(estimate.object_id) == len(truth)
    assert (estimate.existence > 0.9).all()
    between = estimate.moves.gap[:, 0] == 3
    assert (estimate.moves.probability[between] < 0.05).all()


def test_a_thing_that_was_moved_between_visits_is_one_object_that_moved():
    run, truth = small_run(frames=4, visits=2, moved={"mug": (0.02, 0.2)})
    estimate = smoothed(run, CONFIG)
    assert len(estimate.object_id) == len(truth)
    assert (estimate.existence > 0.9).all()
    mug = row_of(estimate, truth, "mug", 0)
    step = estimate.pose[mug, 4, :3, 3] - estimate.pose[mug, 3, :3, 3]
    assert np.linalg.norm(step[:2] - [0.1, 0.2]) < 0.05
    own = (estimate.moves.object == mug) & (estimate.moves.gap[:, 0] == 3)
    np.testing.assert_allclose(estimate.moves.probability[own], 1.0, atol=0.05)
    # from the table to the table
    assert estimate.moves.from_support[own] == estimate.moves.to_support[own]
    (surface,) = -1 - estimate.moves.to_support[own]
    assert abs(estimate.meta["surfaces"][surface]["offset_m"]) < 0.01
    other = (estimate.moves.object == 1 - mug) & (estimate.moves.gap[:, 0] == 3)
    assert (estimate.moves.probability[other] < 0.05).all()


def test_a_single_lying_score_vector_changes_nothing(scene):
    run, truth = scene
    lie = np.array([0.0, 0.0, 1.0, 0.0])  # a banana, surely

    def swapped(frame):
        if frame.index != 2:
            return frame
        return replace(frame, detections=tuple(replace(d, class_scores=lie) for d in frame.detections))

    visits = tuple(replace(v, frames=tuple(swapped(f) for f in v.frames)) for v in run.visits)
    estimate = smoothed(replace(run, visits=visits), CONFIG)
    for name in truth:
        source = next(c for c in run.catalogue.classes if c.name == name)
        assert (estimate.best_class[row_of(estimate, truth, name)] == source.obj_id).all()


def test_without_boxes_there_is_nothing_but_the_camera():
    run, _ = small_run(frames=3, seen=lambda k, name: False)
    estimate = smoothed(run, CONFIG)
    assert len(estimate.object_id) == 0
    np.testing.assert_allclose(estimate.T_world_camera, [f.T_world_camera for f in run.frames], atol=1e-9)


def test_t_map_has_no_context_factors(scene):
    estimate = smoothed(scene[0], CONFIG, context=False)
    assert estimate.meta["method"] == "smooth-t"
    assert "context" not in estimate.meta["diagnostics"]["factors"]


def test_hypotheses_of_the_forward_pass_go_in_and_nothing_else(scene, tmp_path):
    """That it was sure is used. How sure, where of and why isn't: the same data would be counted twice."""
    run, _ = scene
    forward = filter_run(run, CONFIG)
    modes = replace(forward.modes, covariance=100.0 * forward.modes.covariance)
    ledger = replace(forward.ledger, nats=-forward.ledger.nats)
    sure = np.where(forward.existence > 0.5, 0.6, forward.existence)
    other = replace(forward, modes=modes, ledger=ledger, existence=sure)
    for name, start in (("a", forward), ("b", other)):
        smooth_run(run, start, CONFIG).save(tmp_path / f"{name}.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_what_nothing_detects_is_no_object_however_well_a_mesh_explains_the_depth(scene):
    run, _ = scene
    visits = tuple(replace(v, frames=tuple(replace(f, detections=()) for f in v.frames)) for v in run.visits)
    estimate = smooth_run(replace(run, visits=visits), filter_run(run, CONFIG), CONFIG)
    assert (estimate.existence == 0.0).all()


def test_a_forward_pass_of_another_run_is_refused(scene):
    other = replace(scene[0], fingerprint="of other images")
    with pytest.raises(ValueError, match="another run"):
        smooth_run(scene[0], filter_run(other, CONFIG), CONFIG)
