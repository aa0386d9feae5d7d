"""Laws of the proposals: the truth is among them, each mode once, and as certain as the image allows."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from ctmap_gtsam.frontend.proposer import Proposer, in_turn
from ctmap_gtsam.frontend.scoring import refine_on_depth
from ctmap_gtsam.frontend.surroundings import Surroundings
from ctmap_gtsam.model import Model
from factors.symmetry import residual
from sequences import se3
from sequences.catalogue import Catalogue, Mesh
from sequences.geometry import find_planes
from sequences.rendering.rasteriser import Rasteriser
from sequences.seeds import generator
from tests.ctmap_gtsam.scenes import (
    box_of,
    classes,
    config_of,
    detection_of,
    frame_of,
    looking,
    model_of,
    shape_named,
    standing,
    view_of,
)

NAMES = ("mug", "banana", "hammer", "cereal_box", "soup_can", "sponge")
MODEL = model_of(*NAMES)
NOTHING = Surroundings((), ())


def scene(name, seed=0, **options):
    """Proposer, shape, view, observation and the true T_camera_centre of one thing on the table."""
    rng = np.random.default_rng(seed)
    model = MODEL
    shape = shape_named(model, name)
    T_world_camera = looking(rng.uniform(-3, 3), 0.65, rng.uniform(0.5, 0.9))
    pose = standing(shape, 0.0, 0.0, rng.uniform(-3, 3))
    observation = view_of(model, [(shape, pose)], T_world_camera)
    proposer = Proposer(model)
    detection = observation.frame.detections[0]
    view = proposer.view(observation, np.array(detection.box), detection, **options)
    return proposer, shape, view, observation, se3.inverse(T_world_camera) @ pose


def table_top(observation):
    """What the thing stands on, as found in the image."""
    frame = observation.frame
    planes = [
        p.moved(frame.T_world_camera) for p in find_planes(frame.camera, observation.depth, generator(0, "planes"))
    ]
    return Surroundings((), tuple(p for p in planes if p.normal[2] > 0.9))


def errors(T, poses, shape):
    r = residual(T, poses, shape.symmetry)
    return np.linalg.norm(r[..., :3], axis=-1), np.linalg.norm(r[..., 3:], axis=-1)


@pytest.mark.parametrize("name", NAMES)
def test_from_five_centimetres_and_twenty_degrees_exact_depth_gives_the_truth(name):
    """Law 8 of the model, by the registration that a search does: wide at first, then narrow."""
    proposer, shape, view, _, T = scene(name)
    rng = np.random.default_rng(1)
    direction = rng.normal(size=(48, 2, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    starts = se3.retract(T, (direction * [[np.radians(20.0)], [0.05]]).reshape(48, 6))
    widths = np.geomspace(*proposer.settings.refinement_widths_m, 10)
    nearer, _ = refine_on_depth(shape.mesh, shape.normals, view.tile, starts, widths)
    turned, moved = errors(T, proposer.modes(shape, view, nearer, probe=False).T_camera_centre[:1], shape)
    assert turned[0] < np.radians(0.5)
    assert moved[0] < 0.0005


@pytest.mark.parametrize("name", NAMES)
def test_a_search_on_exact_depth_finds_the_truth_or_what_looks_like_it(name):
    proposer, shape, view, observation, T = scene(name)
    starts = proposer.search(shape, view, observation, table_top(observation), generator(0, "test"))
    modes = proposer.modes(shape, view, starts)
    truth, _ = proposer.score(shape, view, T[None])
    assert modes.log_likelihood[0] > truth[0] - 0.5
    turned, moved = errors(T, modes.T_camera_centre, shape)
    assert modes.log_likelihood[0] > truth[0] + 0.1 or ((turned < 0.02) & (moved < 0.001)).any()


@pytest.mark.parametrize("name", ["sponge", "soup_can"])
def test_images_of_one_pose_under_a_symmetry_are_one_mode(name):
    proposer, shape, view, _, T = scene(name)
    images = T @ shape.symmetry.discrete
    if shape.symmetry.free:
        turns = se3.make(se3.so3_exp(np.linspace(-3, 3, 7)[:, None] * shape.symmetry.axes[0]), np.zeros(3))
        images = (images[:, None] @ turns).reshape(-1, 4, 4)
    modes = proposer.modes(shape, view, images, probe=False)
    assert len(modes) == 1
    assert errors(T, modes.T_camera_centre, shape)[1][0] < 0.0005


def test_modes_are_apart_best_first_and_no_more_than_asked_for():
    proposer, shape, view, observation, T = scene("hammer")
    starts = proposer.search(shape, view, observation, NOTHING, generator(0, "test"), 0.5)
    modes = proposer.modes(shape, view, np.concatenate([starts, starts[::-1], T[None]]), probe=False)
    assert 1 <= len(modes) <= proposer.settings.max_modes
    assert (np.diff(modes.log_likelihood) <= 0).all()
    for i in range(len(modes)):
        turned, moved = errors(modes.T_camera_centre[i], np.delete(modes.T_camera_centre, i, axis=0), shape)
        assert ((turned > 0.05) | (moved > 0.004)).all()
    assert len(proposer.modes(shape, view, np.zeros((0, 4, 4)))) == 0


@pytest.mark.parametrize("name", ["banana", "mug", "cereal_box", "soup_can", "hammer"])
def test_near_symmetries_are_turns_after_which_a_thing_looks_nearly_but_not_just_as_before(name):
    shape = shape_named(MODEL, name)
    twins = se3.make(shape.near_symmetries, np.zeros((len(shape.near_symmetries), 3)))
    for T in twins:
        assert errors(np.eye(4), T, shape)[0] > 0.1
        off = np.abs(shape.distance.at(se3.transform(T, shape.mesh.vertices)))
        assert off.mean() < 0.2 * shape.radius_m
    for a in range(len(twins)):
        assert (errors(twins[a], np.delete(twins, a, axis=0), shape)[0] > 0.1).all()


def test_a_banana_has_one_near_symmetry_and_a_can_has_none():
    assert len(shape_named(MODEL, "soup_can").near_symmetries) == 0
    (turn,) = shape_named(MODEL, "banana").near_symmetries
    assert np.linalg.norm(se3.so3_log(turn)) == pytest.approx(np.pi)


@pytest.mark.parametrize("seed", range(3))
def test_whichever_way_round_it_is_tried_both_ways_are_modes(seed):
    """Started as it would look nearly the same, what lies there is found, beside what was started from."""
    proposer, shape, view, _, T = scene("banana", seed)
    turned = T @ se3.make(shape.near_symmetries, np.zeros((1, 3)))
    for start in (T[None], turned):
        modes = proposer.modes(shape, view, start, ways_round=True)
        turn, shift = errors(T, modes.T_camera_centre[0], shape)
        assert turn < 0.05
        assert shift < 0.003
        assert (errors(turned[0], modes.T_camera_centre, shape)[0] < 0.4).any()
        assert (np.diff(modes.log_likelihood) <= 0).all()


def test_what_is_taken_for_the_other_end_of_a_hidden_thing_is_tried_the_other_way():
    """It shows one end, and the rest of it lies in sight there, not behind what stands beside it."""
    proposer, shape, view, _, T = scene("hammer")
    z = Rasteriser().render(shape.mesh, view.tile.camera, T[None])[0]
    columns = np.flatnonzero((z > 0).any(axis=0))
    edge = columns[0] + round(0.1 * len(columns))
    depth = view.tile.depth.copy()
    depth[:, :edge] = 0.3
    view = replace(view, tile=replace(view.tile, depth=depth))
    v, u = np.nonzero(
        (z > 0) & (np.arange(z.shape[1]) >= edge) & (np.arange(z.shape[1]) < columns[0] + 0.3 * len(columns))
    )
    end = se3.make(np.eye(3), (se3.inverse(T) @ [*view.tile.camera.backproject(u, v, z[v, u]).mean(axis=0), 1.0])[:3])
    turns = [np.diag(d) for d in ([1.0, -1, -1], [-1.0, 1, -1], [-1.0, -1, 1])]
    others = np.stack([T @ end @ se3.make(R, np.zeros(3)) @ se3.inverse(end) for R in turns])
    _, scores = proposer.score(shape, view, others)
    start = others[np.argmin(scores.visible / scores.covered)]
    found = proposer.modes(shape, view, start[None], ways_round=True)
    alone = proposer.modes(shape, view, start[None])
    turned, moved = errors(T, found.T_camera_centre[:1], shape)
    assert turned[0] < 0.05
    assert moved[0] < 0.01
    assert errors(T, alone.T_camera_centre, shape)[1].min() > 0.05


def test_no_mode_scores_less_than_its_start():
    proposer, shape, view, _, T = scene("mug")
    starts = se3.retract(T, np.random.default_rng(3).normal(size=(10, 6)) * np.repeat([0.3, 0.02], 3))
    at_start, _ = proposer.score(shape, view, starts)
    modes = proposer.modes(shape, view, starts, probe=False)
    assert modes.log_likelihood[0] >= at_start.max()
    again, scores = proposer.score(shape, view, modes.T_camera_centre)
    np.testing.assert_allclose(again, modes.log_likelihood)
    np.testing.assert_allclose(proposer.model.kappa * scores.log_ratio, modes.depth_log_ratio)


def test_what_a_climb_saw_of_a_mode_is_what_a_look_at_it_sees():
    proposer, shape, view, _, T = scene("mug")
    climbed, known = T[None], {}
    while not known:
        climbed, known = proposer._climb(shape, view, climbed)
    np.testing.assert_allclose(known[0], proposer._probed(shape, view, climbed)[0], rtol=1e-6, atol=1e-14)


def test_the_same_starts_many_times_and_in_any_order_are_the_same_starts():
    proposer, shape, view, _, T = scene("mug")
    rng = np.random.default_rng(4)
    starts = se3.retract(
        T, rng.uniform(0.5, 1.0, size=(6, 6)) * rng.choice([-1, 1], size=(6, 6)) * ([0.5] * 3 + [0.04] * 3)
    )
    many = rng.permutation(np.repeat(starts, 20, axis=0))
    once, often = (proposer.modes(shape, view, some, probe=False) for some in (starts, many))
    np.testing.assert_array_equal(once.T_camera_centre, often.T_camera_centre)
    np.testing.assert_array_equal(once.log_likelihood, often.log_likelihood)


def test_of_many_starts_the_best_is_looked_at_closely():
    proposer, shape, view, _, T = scene("mug")
    far = se3.retract(T, np.random.default_rng(5).normal(size=(200, 6)) * np.repeat([1.5, 0.03], 3))
    alone = proposer.modes(shape, view, T[None], probe=False)
    modes = proposer.modes(shape, view, np.concatenate([far, T[None]]), probe=False)
    assert modes.log_likelihood[0] >= alone.log_likelihood[0]


def bare_cylinder():
    """A model of a smooth cylinder that the catalogue takes for a thing without symmetry."""
    made = trimesh.creation.cylinder(0.035, 0.11, sections=72)
    faces, colours = np.asarray(made.faces, dtype=np.int32), np.full((len(made.vertices), 3), 99, dtype=np.uint8)
    mesh = Mesh(np.asarray(made.vertices, dtype=np.float64), faces, colours)
    (can,) = classes("soup_can").classes
    source = replace(can, mesh=mesh, symmetries_discrete=np.eye(4)[None], symmetries_continuous=())
    return Model(Catalogue((source,)), MODEL.config)


@pytest.mark.parametrize("seed", [0, 2, 3])
def test_a_turn_that_the_image_doesnt_show_is_not_certain(seed):
    rng = np.random.default_rng(seed)
    model = bare_cylinder()
    (shape,) = model.shapes
    T_world_camera = looking(rng.uniform(-3, 3), rng.uniform(0.5, 0.9), rng.uniform(0.3, 0.9))
    pose = standing(shape, yaw=rng.uniform(-3, 3))
    observation = view_of(model, [(shape, pose)], T_world_camera)
    detection = observation.frame.detections[0]
    proposer = Proposer(model)
    view = proposer.view(observation, np.array(detection.box), detection)
    modes = proposer.modes(shape, view, (se3.inverse(T_world_camera) @ pose)[None])
    sigma = np.sqrt(np.diag(modes.covariance[0]))
    assert sigma[2] > np.radians(20.0)
    assert (sigma[:2] < np.radians(5.0)).all()
    assert (sigma[3:] < 0.005).all()


def test_a_turn_that_the_image_shows_is_certain():
    proposer, shape, view, _, T = scene("hammer")
    modes = proposer.modes(shape, view, T[None])
    sigma = np.sqrt(np.diag(modes.covariance[0]))
    assert (sigma[:3] < np.radians(8.0)).all()
    assert (sigma[3:] < 0.01).all()
    assert (np.linalg.eigvalsh(modes.covariance[0]) > 0).all()


def test_a_score_falls_by_half_a_nat_at_a_standard_deviation():
    """What the covariance says is what the score does, direction by direction, to the ladder's coarseness."""
    proposer, shape, view, _, T = scene("banana")
    modes = proposer.modes(shape, view, T[None])
    values, vectors = np.linalg.eigh(modes.covariance[0])
    steps = np.sqrt(values) * vectors
    both = np.stack([steps.T, -steps.T])
    best = modes.T_camera_centre[0]
    plain = replace(view, detection=None)
    top = proposer.score(shape, plain, best[None])[1].log_ratio
    moved = proposer.score(shape, plain, se3.retract(best, both.reshape(-1, 6)))[1].log_ratio
    drop = proposer.model.kappa * (top - moved).reshape(2, 6).mean(0)
    assert ((drop > 0.1) & (drop < 2.5)).all()


def test_less_news_makes_a_mode_less_certain_and_less_of_an_argument():
    proposer, shape, view, _, T = scene("mug")
    full, some = (proposer.modes(shape, replace(view, share=share), T[None]) for share in (1.0, 0.1))
    assert some.log_likelihood[0] == pytest.approx(0.1 * full.log_likelihood[0], rel=0.05)
    assert np.trace(some.covariance[0]) > np.trace(full.covariance[0])


def test_the_right_class_explains_depth_better_than_clutter_and_others():
    model = MODEL
    for name in ("mug", "banana", "cereal_box"):
        proposer, shape, view, observation, T = scene(name)
        own, _ = proposer.score(shape, view, T[None])
        assert own[0] > proposer.log_clutter(shape, view, T, first=False) > 0.0
        for other in model.shapes:
            if other is shape:
                continue
            starts = proposer.search(other, view, observation, NOTHING, generator(0, "test"), 0.2)
            assert proposer.modes(other, view, starts, probe=False).log_likelihood[0] < own[0] - 1.0


def test_an_empty_table_speaks_against_a_thing_on_it():
    proposer, shape, _view, observation, T = scene("mug")
    empty = view_of(MODEL, [], observation.frame.T_world_camera)
    box = np.array(box_of(shape, T))
    bare = proposer.view(empty, box, None)
    assert proposer.score(shape, bare, T[None])[0][0] < -3.0
    hidden = frame_of(0, observation.frame.T_world_camera, np.full_like(observation.depth, 0.2))
    unseen = proposer.view(replace(empty, frame=hidden, depth=hidden.read_depth()), box, None)
    assert proposer.score(shape, unseen, T[None])[0][0] == pytest.approx(0.0, abs=1e-3)


def test_leaving_ones_box_is_never_rewarded():
    proposer, shape, view, _, T = scene("cereal_box")
    with_box, _ = proposer.score(shape, view, T[None])
    shift = detection_of(shape, se3.make(np.eye(3), np.array([0.1, 0, 0])) @ T, len(MODEL.shapes))
    elsewhere, _ = proposer.score(shape, replace(view, detection=shift), T[None])
    missed, _ = proposer.score(shape, replace(view, detection=None), T[None])
    assert with_box[0] > elsewhere[0]
    assert with_box[0] > missed[0]


def test_a_box_bounds_what_a_pose_may_gain_by_explaining_other_things():
    """With a soup can beside a mug: the mug's box says of the mug what it said, of the can next to nothing."""
    mug, other = shape_named(MODEL, "mug"), shape_named(MODEL, "soup_can")
    camera = looking(0.0, 0.65, 0.7)
    poses = [(mug, standing(mug)), (other, standing(other, 0.11, 0.0))]
    observation = view_of(MODEL, poses, camera)
    detection = observation.frame.detections[0]
    proposer = Proposer(MODEL)
    view = proposer.view(observation, np.array(detection.box), detection)
    T = [se3.inverse(camera) @ pose for _, pose in poses]
    for shape, pose, mine in ((mug, T[0], True), (other, T[1], False)):
        bounded_ = proposer.score(shape, view, pose[None])[1]
        free = proposer.score(shape, replace(view, tile=_unbounded(proposer, observation, detection)), pose[None])[1]
        assert bounded_.covered[0] == free.covered[0] > 20
        if mine:
            assert bounded_.log_ratio[0] == pytest.approx(free.log_ratio[0], rel=0.02)
        else:
            assert free.log_ratio[0] > free.covered[0]
            assert bounded_.log_ratio[0] < 0.1 * free.log_ratio[0]


def _unbounded(proposer, observation, detection):
    """The tile of a box that nobody detected."""
    return proposer.view(observation, np.array(detection.box), None).tile


def test_clutter_explains_what_stands_before_a_pose_as_well():
    """A pose behind the surface that is seen gains nothing over clutter by calling that surface an occluder."""
    proposer, shape, view, _, T = scene("cereal_box")
    behind = se3.make(np.eye(3), np.array([0.0, 0.0, 0.15])) @ T
    mine, hidden = (proposer.log_clutter(shape, view, pose, first=True) for pose in (T, behind))
    assert hidden > 0.5 * mine
    own, _ = proposer.score(shape, view, np.stack([T, behind]))
    assert own[0] > mine
    assert own[1] < hidden


def test_the_same_draws_give_the_same_search_and_other_draws_another():
    proposer, shape, view, observation, _ = scene("mug")
    a, b, c = (
        proposer.search(shape, view, observation, NOTHING, generator(0, stage), 0.1) for stage in ("x", "x", "y")
    )
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, c)


def test_hypotheses_are_counted():
    proposer, shape, view, _, T = scene("mug")
    proposer.score(shape, view, np.tile(T, (17, 1, 1)))
    assert proposer.hypotheses_scored == 17


def test_a_box_without_depth_finds_nothing():
    proposer, shape, view, observation, _ = scene("mug")
    blind = replace(observation, depth=np.zeros_like(observation.depth))
    assert view.detection is not None
    view = proposer.view(blind, np.array(view.detection.box), view.detection)
    assert proposer.search(shape, view, blind, NOTHING, generator(0, "test")).shape == (0, 4, 4)


def test_effort_is_what_the_settings_say():
    model = model_of("mug", config=config_of("frontend.fresh_poses=50", "frontend.refined_poses=6"))
    (shape,) = model.shapes
    observation = view_of(model, [(shape, standing(shape))], looking())
    detection = observation.frame.detections[0]
    counts = []
    for share in (1.0, 0.4):
        proposer = Proposer(model)
        view = proposer.view(observation, np.array(detection.box), detection)
        proposer.search(shape, view, observation, NOTHING, generator(0, "test"), share)
        counts.append(proposer.hypotheses_scored)
    assert 50 <= counts[0] <= 100
    assert counts[1] < counts[0]


@given(st.lists(st.tuples(st.sampled_from([0.0, 1.5, 3.0]), st.floats(0.0, 8.0)), min_size=1, max_size=9))
def test_ways_round_that_a_view_hardly_tells_apart_take_turns(found):
    """Each has as many modes as the others, or all of its own; what is behind them comes after, by its score."""
    shape = shape_named(MODEL, "mug")
    poses = se3.exp(np.array([[turn, 0.0, 0.0, 0.0, 0.0, 1.0 + 0.1 * n] for n, (turn, _) in enumerate(found)]))
    score = -np.array([behind for _, behind in found])
    rows = [int(row) for row in np.argsort(-score, kind="stable")]
    order = in_turn(shape, poses, score, rows)
    assert sorted(order) == sorted(rows)
    assert order[0] == rows[0]
    turns = np.array([turn for turn, _ in found])
    level = [t for t in set(turns) if score[turns == t].max() > score.max() - 3.0]
    for n in range(1, len(order)):
        had = [int((turns[order[:n]] == t).sum()) for t in level]
        whole = [int((turns == t).sum()) for t in level]
        assert all(a >= min(max(had), b) - 1 for a, b in zip(had, whole, strict=True))
    rest = [row for row in order if turns[row] not in level]
    assert order[len(order) - len(rest) :] == rest
    assert (np.diff(score[rest]) <= 0.0).all()
