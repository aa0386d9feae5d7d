"""Laws of the fused kernel and of the registration on depth."""

from dataclasses import replace

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmap_gtsam.frontend.scoring import Tile, coarser, cut_tile, refine_on_depth, score_depth
from factors.measurement import DepthModel, depth_log_ratio
from factors.symmetry import residual
from sequences import se3
from sequences.rendering.rasteriser import Rasteriser
from tests.ctmap_gtsam.scenes import CAMERA, depth_of, looking, model_of, shape_named, standing

NAMES = ("mug", "banana", "hammer", "cereal_box", "bowl")
MODEL = model_of(*NAMES)
DEPTH = DepthModel()
MARGIN = 0.02
WIDTHS = np.geomspace(0.03, 0.002, 30)


def whole_image(depth, background=None):
    """All of a depth image as a tile."""
    background = np.zeros_like(depth) if background is None else background.astype(np.float32)
    return Tile(CAMERA, np.ascontiguousarray(depth), background, 0, 0, 1)


def some_view(name, seed, noise=0.002):
    """A shape on a table before a camera: its pose in the camera frame, and noisy depth with holes."""
    rng = np.random.default_rng(seed)
    shape = shape_named(MODEL, name)
    T_world_camera = looking(rng.uniform(-3, 3), rng.uniform(0.6, 0.9), rng.uniform(0.4, 1.0))
    pose = standing(shape, *rng.uniform(-0.05, 0.05, 2), rng.uniform(-3, 3))
    depth = depth_of([(shape, pose)], T_world_camera)
    depth = np.where(depth > 0, depth + noise * rng.normal(size=depth.shape), 0.0)
    depth[rng.random(depth.shape) < 0.05 * (noise > 0)] = 0.0
    return shape, se3.inverse(T_world_camera) @ pose, depth.astype(np.float32), rng


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("known", [False, True], ids=["background unknown", "background known"])
def test_the_fused_score_is_the_potential_summed_over_a_rendering(name, known):
    shape, T, depth, rng = some_view(name, 1)
    table = depth_of([], looking()) if known else np.zeros_like(depth)
    poses = se3.retract(T, rng.normal(size=(6, 6)) * np.repeat([0.2, 0.01], 3))
    tile = whole_image(depth, table)
    scores = score_depth(shape.mesh, tile, poses, DEPTH.parameters(), MARGIN)
    rendered = Rasteriser().render(shape.mesh, CAMERA, poses)
    expected = depth_log_ratio(depth, rendered, table, DEPTH)
    np.testing.assert_allclose(scores.log_ratio, expected.sum((1, 2)), rtol=1e-5, atol=0.02)
    np.testing.assert_array_equal(scores.covered, (rendered > 0).sum((1, 2)))
    seen = (rendered > 0) & (depth > 0) & (depth > rendered - MARGIN)
    np.testing.assert_allclose(scores.visible, seen.sum((1, 2)), atol=1)
    for k in range(len(poses)):
        rows, columns = np.flatnonzero(seen[k].any(1)), np.flatnonzero(seen[k].any(0))
        box = [columns[0] - 0.5, rows[0] - 0.5, columns[-1] + 0.5, rows[-1] + 0.5]
        np.testing.assert_allclose(scores.box[k], box, atol=1.0)


def test_a_tile_with_another_background_is_scored_anew():
    shape, T, depth, _ = some_view("mug", 2)
    first, table = whole_image(depth), depth_of([], looking()).astype(np.float32)

    def ratio(tile):
        return score_depth(shape.mesh, tile, T[None], DEPTH.parameters(), MARGIN).log_ratio[0]

    before = ratio(first)
    assert ratio(replace(first, background=table)) == ratio(whole_image(depth, table)) != before
    assert ratio(first) == before


@settings(max_examples=20)
@given(st.integers(0, 2**31), st.integers(1, 4))
def test_a_window_scores_the_samples_that_it_takes_from_the_image(seed, step):
    shape, T, depth, rng = some_view("mug", seed)
    low = rng.uniform([-20, -20], [120, 80])
    box = np.concatenate([low, low + rng.uniform(40, 250, 2)])
    tile = cut_tile(CAMERA, depth, (), box, step)
    inside = np.zeros(depth.shape, dtype=bool)
    inside[tile.y : tile.y + step * tile.depth.shape[0] : step, tile.x : tile.x + step * tile.depth.shape[1] : step] = 1
    x0, y0, x1, y1 = box
    taken = np.argwhere(inside)[:, ::-1]
    assert ((taken >= [np.floor(x0), np.floor(y0)]) & (taken <= [x1, y1])).all()
    full = score_depth(shape.mesh, whole_image(np.where(inside, depth, 0.0)), T[None], DEPTH.parameters(), MARGIN)
    part = score_depth(shape.mesh, tile, T[None], DEPTH.parameters(), MARGIN)
    np.testing.assert_allclose(part.log_ratio, full.log_ratio, rtol=1e-6, atol=0.05)
    np.testing.assert_allclose(part.visible, full.visible, atol=1)


def test_a_box_beyond_the_image_gives_a_tile_of_at_least_a_sample():
    depth = depth_of([], looking())
    for box in ([-50.0, -50.0, -10.0, -10.0], [400.0, 300.0, 500.0, 380.0], [10.0, 10.0, 10.0, 10.0]):
        tile = cut_tile(CAMERA, depth, (), np.array(box), 3)
        assert tile.depth.size >= 1
        assert tile.background.shape == tile.depth.shape


def test_a_coarser_tile_has_a_sample_of_each_block_and_the_same_geometry():
    shape, T, depth, _ = some_view("bowl", 3, noise=0.0)
    tile = cut_tile(CAMERA, depth, (), np.array([20.0, 10.0, 300.0, 220.0]), 2)
    coarse = coarser(tile, 2)
    np.testing.assert_array_equal(coarse.depth, depth[tile.y : 220 : 4, tile.x : 300 : 4])
    fine, few = (score_depth(shape.mesh, t, T[None], DEPTH.parameters(), MARGIN) for t in (tile, coarse))
    assert few.covered[0] == pytest.approx(fine.covered[0] / 4, rel=0.1)
    assert few.log_ratio[0] == pytest.approx(fine.log_ratio[0] / 4, rel=0.1)
    np.testing.assert_allclose(few.box, fine.box, atol=6.0)


def test_what_covers_no_sample_scores_nothing_and_has_no_box():
    shape, T, depth, _ = some_view("mug", 4)
    away = np.stack([se3.make(np.eye(3), np.array([0, 0, -1.0])) @ T, se3.make(np.eye(3), np.array([9.0, 0, 0])) @ T])
    scores = score_depth(shape.mesh, whole_image(depth), away, DEPTH.parameters(), MARGIN)
    np.testing.assert_array_equal(scores.log_ratio, 0.0)
    np.testing.assert_array_equal(scores.covered, 0)
    assert np.isnan(scores.box).all()


def test_being_hidden_is_no_evidence_and_being_seen_past_is_much():
    shape, T, depth, _ = some_view("cereal_box", 5, noise=0.0)
    hidden = whole_image(np.full_like(depth, 0.3))
    past = whole_image(np.full_like(depth, 3.0))
    scores = [score_depth(shape.mesh, t, T[None], DEPTH.parameters(), MARGIN) for t in (hidden, past)]
    assert scores[0].log_ratio[0] == pytest.approx(0.0, abs=1e-3)
    assert scores[0].visible[0] == 0
    assert scores[1].log_ratio[0] < -2.0 * scores[1].covered[0]


def test_the_truth_scores_best():
    for name in NAMES:
        shape, T, depth, rng = some_view(name, 6)
        around = se3.retract(T, rng.normal(size=(40, 6)) * np.repeat([0.3, 0.02], 3))
        scores = score_depth(
            shape.mesh, whole_image(depth), np.concatenate([T[None], around]), DEPTH.parameters(), MARGIN
        )
        far = np.abs(residual(around, T, shape.symmetry)) @ np.repeat([0.05, 1.0], 3) > 0.02
        assert (scores.log_ratio[1:][far] < scores.log_ratio[0]).all()


@pytest.mark.parametrize("name", NAMES)
def test_registration_comes_back_from_two_centimetres_and_ten_degrees(name):
    shape, T, depth, rng = some_view(name, 7, noise=0.0)
    direction = rng.normal(size=(24, 2, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    starts = se3.retract(T, (direction * [[np.radians(10.0)], [0.02]]).reshape(24, 6))
    refined, _ = refine_on_depth(shape.mesh, shape.normals, whole_image(depth), starts, WIDTHS)
    before = score_depth(shape.mesh, whole_image(depth), starts, DEPTH.parameters(), MARGIN).log_ratio
    after = score_depth(shape.mesh, whole_image(depth), refined, DEPTH.parameters(), MARGIN).log_ratio
    assert (after > before).mean() > 0.9
    r = residual(refined, T, shape.symmetry)
    reduced = np.linalg.norm(r[:, :3], axis=-1), np.linalg.norm(r[:, 3:], axis=-1)
    back = (reduced[0] < 0.02) & (reduced[1] < 0.001)
    assert back.mean() > 0.75


def test_the_truth_stays_where_it_is():
    for name in NAMES:
        shape, T, depth, _ = some_view(name, 8, noise=0.0)
        refined, hessian = refine_on_depth(shape.mesh, shape.normals, whole_image(depth), T[None], WIDTHS[-5:])
        r = residual(refined, T[None], shape.symmetry)[0]
        assert np.linalg.norm(r[:3]) < 0.002
        assert np.linalg.norm(r[3:]) < 0.0002
        np.testing.assert_allclose(hessian[0], hessian[0].T)
        assert np.linalg.eigvalsh(hessian[0])[0] > -1e-6 * np.linalg.eigvalsh(hessian[0])[-1]


def test_a_start_beside_everything_stays_finite():
    shape, T, depth, _ = some_view("mug", 9)
    starts = np.stack([se3.make(np.eye(3), np.array([x, 0, z])) @ T for x, z in ((5.0, 0), (0, -3.0), (0, 5.0))])
    refined, hessian = refine_on_depth(shape.mesh, shape.normals, whole_image(depth), starts, WIDTHS)
    np.testing.assert_allclose(refined[:2], starts[:2], atol=1e-9)
    assert np.isfinite(refined).all()
    assert np.isfinite(hessian).all()


def test_answers_dont_hang_on_the_batch_nor_on_the_number_of_threads():
    shape, T, depth, rng = some_view("banana", 10)
    tile = whole_image(depth)
    poses = se3.retract(T, rng.normal(size=(9, 6)) * np.repeat([0.2, 0.01], 3))
    before = numba.get_num_threads()
    answers = []
    try:
        for threads in (1, before):
            numba.set_num_threads(threads)
            scores = score_depth(shape.mesh, tile, poses, DEPTH.parameters(), MARGIN)
            refined, hessian = refine_on_depth(shape.mesh, shape.normals, tile, poses, WIDTHS)
            answers.append((scores.log_ratio, scores.box, refined, hessian))
    finally:
        numba.set_num_threads(before)
    for one, many in zip(*answers, strict=True):
        np.testing.assert_array_equal(one, many)
    alone = score_depth(shape.mesh, tile, poses[4:5], DEPTH.parameters(), MARGIN)
    np.testing.assert_array_equal(alone.log_ratio, answers[0][0][4:5])
