"""Laws of the ledger: it sums to the energy of the graph; a potential says one thing in filter, graph and ledger."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.filtering.belief import ClassBelief, Glimpse
from ctmap_gtsam.filtering.filter import filter_run
from ctmap_gtsam.filtering.particles import Particles
from ctmap_gtsam.filtering.reporting import Reporter
from ctmap_gtsam.frontend.proposer import Proposer
from ctmap_gtsam.frontend.surroundings import Neighbour, Surroundings
from ctmap_gtsam.smoothing.graph import Camera, Measured, build
from ctmap_gtsam.smoothing.lagged import lagged_run
from ctmap_gtsam.smoothing.smoother import smooth_run
from sequences import se3
from sequences.bop import load_run
from sequences.types import LocalisationNoise
from tests.ctmap_gtsam.beliefs import belief_of
from tests.ctmap_gtsam.scenes import CHEAP, config_of, looking, model_of, shape_named, small_run, standing, view_of

QUICK = (*CHEAP, "frontend.start_after=2", "frontend.angular_step_rad=0.01", "frontend.mesh_faces=200")
CONFIG = config_of(*QUICK)
GRAPH = ("localisation", "bias", "measurement", "prediction", "context", "standing", "gauge")
FOOD = model_of("soup_can", "banana", "mug")


def smoothed(run, config):
    """The filter's estimate, the smoother's, and the last round's graph and its solution."""
    forward = filter_run(run, config)
    seen = []
    estimate = smooth_run(run, forward, config, look=lambda *pair: seen.append(pair))
    return forward, estimate, *seen[0]


@pytest.fixture(scope="module")
def answers():
    """Two things of one category, one of them round, in two visits, seen by a camera that isn't localised exactly."""
    run, _ = small_run(("soup_can", "banana"), ("mug",), frames=4, visits=2)
    return smoothed(replace(run, localisation=LocalisationNoise(0.002, 0.002)), CONFIG)


def nats(estimate: Estimate, potential: str, **where: int) -> np.ndarray:
    """The lines of one potential, of an object, at a keyframe, or of a neighbour."""
    ledger = estimate.ledger
    own = ledger.potential == estimate.meta["potentials"].index(potential)
    for name, value in where.items():
        own &= getattr(ledger, name) == value
    return ledger.nats[own]


def check_the_sum_is_the_energy(estimate, built, solution):
    """Law 5 of the model, against GTSAM's own graph; by kind, and a line a factor."""
    values = solution.solution.values
    kinds = built.energy(values)
    assert tuple(estimate.meta["graph_potentials"]) == GRAPH
    total = sum(float(nats(estimate, kind).sum()) for kind in GRAPH)
    assert -total == pytest.approx(built.to_gtsam().error(values), rel=1e-9)
    assert -total == pytest.approx(estimate.meta["diagnostics"]["solver"]["trace"][-1], rel=1e-9)
    for kind, count in built.count().items():
        assert len(nats(estimate, kind)) == count
        assert -nats(estimate, kind).sum() == pytest.approx(kinds[kind], rel=1e-9, abs=1e-12)
    assert kinds["measurement"] > 0.0


def test_the_sum_of_the_ledger_is_the_energy_of_the_graph(answers):
    _, estimate, built, solution = answers
    assert built.count().keys() == set(GRAPH)
    check_the_sum_is_the_energy(estimate, built, solution)


def test_the_sum_of_the_ledger_is_the_energy_of_the_graph_after_smoothing_a_recording(data):
    run = load_run(data / "visp_rbt")
    config = config_of(*QUICK, f"keyframes.every={len(run.frames) // 5}")
    _, estimate, built, solution = smoothed(run, config)
    assert len(estimate.object_id) > 0
    check_the_sum_is_the_energy(estimate, built, solution)


def test_each_factor_is_a_line_of_its_own_objects_and_keyframe(answers):
    _, estimate, built, solution = answers
    rows = {int(i): row for row, i in enumerate(estimate.object_id)}
    values = solution.solution.values
    for label, error in zip(built.labels, built.errors(values), strict=True):
        words = label.name.split()
        if label.kind in ("measurement", "gauge", "prediction", "standing"):
            found = nats(estimate, label.kind, object=rows[int(words[1])], keyframe=int(words[3]), other=-1)
        elif label.kind == "context":
            pair = {"object": rows[int(words[1])], "other": rows[int(words[3])]}
            found = nats(estimate, label.kind, keyframe=int(words[5]), **pair)
        elif label.kind == "bias":
            first = int(np.flatnonzero(estimate.keyframe_visit == int(words[3]))[0])
            found = nats(estimate, label.kind, object=rows[int(words[1])], keyframe=first)
        else:
            found = nats(estimate, label.kind, object=-1, keyframe=int(words[-1]), other=-1)
        assert found == pytest.approx([-error])


def test_every_object_has_what_the_trellis_weighs_at_each_keyframe(answers):
    _, estimate, *_ = answers
    keyframes = len(estimate.keyframe_frame)
    for row in range(len(estimate.object_id)):
        for name in ("depth", "detection", "surroundings", "clutter", "witness"):
            assert len(nats(estimate, name, object=row)) == keyframes
        assert len(nats(estimate, "persistence", object=row)) == keyframes - 1
        assert len(nats(estimate, "class", object=row)) == 1


def test_a_gap_says_the_same_in_filter_and_smoother(answers):
    """Equation 3, of a thing that is believed to have stayed."""
    forward, estimate, *_ = answers
    back = int(np.flatnonzero(estimate.keyframe_visit == 1)[0])
    away_s = float(np.diff(estimate.keyframe_time_ns)[back - 1]) * 1e-9
    assert len(estimate.object_id) == 2
    for row, i in enumerate(estimate.object_id):
        theirs = nats(forward, "persistence", object=forward.object_id.tolist().index(i), keyframe=back)
        mu = FOOD.catalogue[int(estimate.best_class[row, back])].persistence_s
        assert nats(estimate, "persistence", object=row, keyframe=back) == theirs
        assert theirs == pytest.approx(np.log(0.5 + 0.5 * np.exp(-away_s / mu)))


def test_a_lag_writes_each_keyframes_factors_once():
    """As the window had them when the keyframe was said."""
    run, _ = small_run(("soup_can", "banana"), ("mug",), frames=5)
    forward = filter_run(run, CONFIG)
    whole, lagged = smooth_run(run, forward, CONFIG), lagged_run(run, forward, CONFIG, lag=1)
    for kind in GRAPH:
        assert len(nats(lagged, kind)) <= len(nats(whole, kind))
    assert len(nats(lagged, "localisation")) == len(lagged.keyframe_frame)
    measured = lagged.ledger.potential == lagged.meta["potentials"].index("measurement")
    lines = list(zip(lagged.ledger.object[measured], lagged.ledger.keyframe[measured], strict=True))
    assert len(set(lines)) == len(lines) > len(lagged.object_id)


def reported(model, shape, T, view, *, around=(), before=None, waited_s=None):
    """What the filter says of an object whose particles are all at one pose."""
    reporter = Reporter(model, Proposer(model), LocalisationNoise())
    own = ClassBelief(Particles(T[None], np.zeros(1)), 100.0)
    classes = tuple(own if s is shape else None for s in model.shapes)
    camera, observation, tile = view
    glimpse = Glimpse(tile, observation.frame.T_camera_world, waited_s)
    belief = belief_of(classes, object_id=1, viewpoint=camera[:3, 3] - T[:3, 3], glimpse=glimpse)
    said = reporter.report(belief, Surroundings(tuple(around), ()), before)
    return said, {(line.potential, line.other): line.nats for line in said.ledger}


@pytest.fixture(scope="module")
def view():
    """A camera, its image of a can, and the region of the can's box."""
    camera = looking()
    can = shape_named(FOOD, "soup_can")
    observation = view_of(FOOD, [(can, standing(can))], camera)
    detection = observation.frame.detections[0]
    return camera, observation, Proposer(FOOD).view(observation, np.array(detection.box), detection, None, 0.7)


@settings(max_examples=15)
@given(st.integers(0, 2**31), st.sampled_from(["soup_can", "banana"]), st.floats(0.1, 30.0))
def test_prediction_and_context_say_the_same_in_filter_graph_and_ledger(view, seed, name, dt_s):
    """At the same poses, where localisation is exact; in the graph context is a share a keyframe of one fact."""
    rng = np.random.default_rng(seed)
    shape, other = shape_named(FOOD, name), shape_named(FOOD, {"soup_can": "banana", "banana": "soup_can"}[name])
    first = se3.retract(standing(shape), 0.003 * rng.normal(size=6))
    second = se3.retract(first, 0.01 * rng.normal(size=6))
    beside = standing(other, *rng.uniform(-0.4, 0.4, size=2))
    times = (0.0, dt_s)

    def measured(poses):
        return [Measured(k, times[k], 0, T, 1e-4 * np.eye(6), stays=k > 0) for k, T in enumerate(poses)]

    cameras = [Camera(np.eye(4), t, 0) for t in times]
    objects = {1: (shape, measured([first, second])), 2: (other, measured([beside, beside]))}
    built = build(FOOD, cameras, LocalisationNoise(), objects)
    graph = built.contributions(built.initial)
    before, _ = reported(FOOD, shape, first, view)
    said, lines = reported(
        FOOD, shape, second, view, around=[Neighbour(2, other, beside, 10.0)], before=before, waited_s=dt_s
    )
    np.testing.assert_allclose(said.best_pose, second, atol=1e-9)

    def factor(kind):
        rows = [n for n, k in enumerate(graph.kind) if k == kind and graph.object[n] == 1 and graph.keyframe[n] == 1]
        assert len(rows) == 1
        return graph.nats[rows[0]]

    assert lines["prediction", None] == pytest.approx(factor("prediction"), rel=1e-6, abs=1e-9)
    assert lines["context", 2] == pytest.approx(2.0 * factor("context"), rel=1e-6, abs=1e-9)


def test_depth_and_detection_say_the_same_in_filter_and_smoother(view):
    """At a mode: what the smoother writes of it is what the filter writes where it reports that pose."""
    camera, _, tile = view
    can, proposer = shape_named(FOOD, "soup_can"), Proposer(FOOD)
    start = se3.inverse(camera) @ se3.retract(standing(can), np.full(6, 0.004))
    modes = proposer.modes(can, tile, start[None])
    counted = proposer.hypotheses_scored
    assert proposer.told(can, tile, modes.T_camera_centre[0]) == pytest.approx(
        (modes.depth_log_ratio[0], modes.log_likelihood[0] - modes.depth_log_ratio[0]), abs=1e-9
    )
    assert proposer.hypotheses_scored == counted
    _, lines = reported(FOOD, can, camera @ modes.T_camera_centre[0], view)
    depth = float(modes.depth_log_ratio[0])
    assert lines["depth", None] == pytest.approx(depth, rel=1e-3)
    assert lines["depth", None] + lines["detection", None] == pytest.approx(modes.log_likelihood[0], rel=1e-3)
    assert depth > 1.0
