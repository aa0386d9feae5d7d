"""Laws of the paper's filter to the letter."""

from dataclasses import replace

import numpy as np
import pytest

from ctmap_gtsam.filtering.literal import Cloud, _Filter, literal_filter_run
from ctmap_gtsam.frontend.scoring import cut_tile, squared_differences
from factors.persistence import stay_probability
from sequences import se3
from sequences.rendering.scene import render_scene
from tests.ctmap_gtsam.scenes import (
    CAMERA,
    UP,
    assert_begins_with,
    assert_the_seed_decides,
    config_of,
    cut,
    depth_of,
    looking,
    model_of,
    shape_named,
    small_run,
    standing,
)

CONFIG = config_of("paper.particles=400")


@pytest.fixture(scope="module")
def scene():
    return small_run()


@pytest.fixture(scope="module")
def estimate(scene):
    return literal_filter_run(scene[0], CONFIG)


def test_differences_are_those_of_the_rendered_images():
    model = model_of("mug", "cereal_box")
    camera = looking()
    truth = [(shape_named(model, "mug"), standing(shape_named(model, "mug")))]
    depth = depth_of(truth, camera).astype(np.float32)
    tile = cut_tile(CAMERA, depth, (), np.array([40.0, 30.0, 280.0, 220.0]), 2)
    for shape in model.shapes:
        poses = se3.inverse(camera) @ np.stack([standing(shape), standing(shape, 0.03, 0.01, 0.4)])
        for found, T in zip(squared_differences(shape.mesh, tile, poses), poses, strict=True):
            drawn = render_scene([(shape.mesh, T)], tile.camera).depth
            both = (drawn > 0) & (tile.depth > 0)
            assert both.sum() > 50
            assert found == pytest.approx(((drawn - tile.depth)[both].astype(np.float64) ** 2).sum(), rel=1e-3)


@pytest.mark.parametrize("n", [1, 4])
def test_the_first_keyframes_are_those_of_a_run_cut_after_them(scene, estimate, n):
    assert_begins_with(estimate, literal_filter_run(cut(scene[0], n), CONFIG))


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(scene, tmp_path):
    assert_the_seed_decides(lambda seed: literal_filter_run(scene[0], replace(CONFIG, seed=seed)), tmp_path)


def test_what_was_once_seen_exists_for_ever(estimate):
    """Object permanence as the paper has it: nothing weighs against existence."""
    ever = estimate.existence > 0.0
    assert (np.diff(ever.astype(int), axis=1) >= 0).all()
    assert set(np.unique(estimate.existence)) <= {0.0, 1.0}


def test_centres_come_near_things(scene, estimate):
    """Without refinement within centimetres, no better."""
    truth = np.stack([T[:3, 3] for T in scene[1].values()])
    last = estimate.pose[:, -1, :3, 3]
    assert (np.linalg.norm(last[:, None] - truth, axis=-1).min(axis=0) < 0.08).all()


def particles_of(filter_, n, T, seen_s=0.0, class_index=0):
    return Cloud(np.full(n, class_index), np.tile(T, (n, 1, 1)), np.full(n, -np.log(n)), round(seen_s * 1e9))


def test_out_of_view_each_particle_stays_or_moves_by_equation_3_and_in_view_none_does(scene):
    """A move lands on the other object's top."""
    run = scene[0]
    filter_ = _Filter(run, model_of(*[c.name for c in run.catalogue.classes], config=CONFIG))
    filter_.place.up_world = UP
    n, shape = 4000, filter_.model.shapes[0]
    other = filter_.model.shapes[1]
    at = se3.make(np.eye(3), np.array([3.0, 0.0, 0.5]))
    frame, hour = run.frames[0], 3600.0
    frame = replace(frame, time_ns=round(hour * 1e9))
    out_of_view = se3.make(np.eye(3), frame.T_world_camera[:3, 3] - 2.0 * frame.T_world_camera[:3, 2])
    drawn = filter_._predict(particles_of(filter_, n, out_of_view), frame, {9: (1, at)}, np.random.default_rng(0))
    away = np.linalg.norm(drawn.T_world_centre[:, :3, 3] - out_of_view[:3, 3], axis=-1)
    stay = float(stay_probability(hour, shape.source.persistence_s))
    assert (away < 0.1).mean() == pytest.approx(stay, abs=4.0 * np.sqrt(stay * (1.0 - stay) / n) + 1e-3)
    moved = drawn.T_world_centre[away >= 0.1]
    lowest = (shape.hull_points @ np.swapaxes(moved[:, :3, :3], -1, -2))[..., 2].min(axis=-1) + moved[:, 2, 3]
    assert (np.abs(moved[:, :2, 3] - at[:2, 3]).max(axis=0) < other.reach_m).all()
    assert lowest.max() == pytest.approx(at[2, 3] + other.mesh.vertices[:, 2].max(), abs=0.03)
    in_view = standing(shape)
    drawn = filter_._predict(particles_of(filter_, n, in_view), frame, {9: (1, at)}, np.random.default_rng(0))
    steps = se3.local(np.tile(in_view, (n, 1, 1)), drawn.T_world_centre)
    expected = np.repeat([CONFIG.paper.rotation_sigma_rad, CONFIG.paper.translation_sigma_m], 3) / np.sqrt(2.0)
    np.testing.assert_allclose(steps.std(axis=0), expected, rtol=0.08)


def test_context_changes_weights_and_t_map_has_none(scene, estimate):
    alone = literal_filter_run(scene[0], CONFIG, context=False)
    assert (alone.meta["method"], estimate.meta["method"]) == ("paper-t", "paper-ct")
    assert not np.array_equal(alone.class_probability, estimate.class_probability)
