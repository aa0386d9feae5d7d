"""Laws of what stands around an object: surfaces, neighbours, and where it would be seen."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmap_gtsam.frontend.observation import Observation, reaches_beyond, where_in_image
from ctmap_gtsam.frontend.place import Place, describe
from ctmap_gtsam.frontend.proposer import Proposer
from ctmap_gtsam.frontend.surroundings import (
    Neighbour,
    Surroundings,
    heights_above,
    penetration_depth,
    support_log_potential,
)
from ctmap_gtsam.frontend.visibility import outlook
from sequences import se3
from sequences.geometry import Plane, PlaneSearch
from tests.ctmap_gtsam.scenes import (
    CAMERA,
    UP,
    box_of,
    classes,
    config_of,
    depth_of,
    frame_of,
    looking,
    model_of,
    run_of,
    shape_named,
    standing,
    view_of,
)

NAMES = ("mug", "banana", "cereal_box", "soup_can")
MODEL = model_of(*NAMES, config=config_of("context.relations.same_category.strength=0.6"))
MUG, BOX, CAN = (shape_named(MODEL, n) for n in ("mug", "cereal_box", "soup_can"))


def surface(height, x=0.0, half=0.5, share=0.3, tilt=0.0):
    """A level square, world frame."""
    T = se3.make(se3.so3_exp(np.array([tilt, 0, 0])), np.array([x, 0.0, height]))
    hull = half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return Plane(T[:3, 2], float(T[:3, 2] @ T[:3, 3]), T, hull, share)


def looked_at(k, planes_world, T=None):
    """A keyframe that shows planes of the world."""
    T = looking(yaw=0.1 * k) if T is None else T
    seen = tuple(p.moved(se3.inverse(T)) for p in planes_world)
    return Observation(k, frame_of(k, T, np.zeros((240, 320), np.float32)), np.zeros((240, 320), np.float32), seen)


def grown(observations, up=None):
    place = Place(replace(run_of(classes("mug"), [observations[0].frame]), up_world=up))
    for observation in observations:
        place.update(observation)
    return place


@settings(max_examples=15)
@given(st.integers(0, 2**31))
def test_up_and_surfaces_come_from_the_past_alone_and_join_views_of_one_surface(seed):
    rng = np.random.default_rng(seed)
    views = []
    for k in range(8):
        noise = rng.normal(size=4) * [0.003, 0.05, 0.02, 0.01]
        table = surface(0.7 + noise[0], noise[1], 0.5 + noise[2], rng.uniform(0.2, 0.5), noise[3])
        floor = surface(rng.normal() * 0.003, 0.3, 0.4, 0.1)
        views.append(looked_at(k, [table, floor] if k % 3 else [table]))
    said = [describe(grown(views[:n])) for n in range(1, 9)]
    place = grown(views[:1])
    for n in range(1, 8):
        assert describe(place) == said[n - 1]
        place.update(views[n])
    assert len(place.surfaces) == 2
    table, floor = sorted(place.surfaces, key=lambda p: -p.offset)
    assert table.offset == pytest.approx(0.7, abs=0.01)
    assert floor.offset == pytest.approx(0.0, abs=0.01)
    assert place.up_world @ UP > np.cos(np.radians(1.5))
    for plane in place.surfaces:
        np.testing.assert_allclose(plane.normal @ plane.T_frame_plane[:3, 3], plane.offset)
        np.testing.assert_allclose(plane.T_frame_plane[:3, :3].T @ plane.T_frame_plane[:3, :3], np.eye(3), atol=1e-9)


def test_a_joined_outline_holds_all_that_was_seen():
    halves = [looked_at(0, [surface(0.7, -0.4, 0.45)]), looked_at(1, [surface(0.7, 0.4, 0.45)])]
    (whole,) = grown(halves, UP).surfaces
    assert whole.contains(np.array([[-0.8, 0.4, 0.7], [0.8, -0.4, 0.7], [0.0, 0.0, 0.7]])).all()
    assert whole.area == pytest.approx(1.7 * 0.9, rel=0.01)


def test_a_wall_carries_nothing_and_a_given_up_is_kept():
    wall = surface(1.0, tilt=np.pi / 2)
    tilted = np.array([0.0, 0.1, np.sqrt(1 - 0.01)])
    place = grown([looked_at(0, [surface(0.7), wall])], tilted)
    assert len(place.surfaces) == 1
    np.testing.assert_array_equal(place.up_world, tilted)
    nowhere = grown([looked_at(0, [])])
    assert nowhere.up_world is None
    assert nowhere.surfaces == ()


def neighbour(i, shape, *where):
    return Neighbour(i, shape, standing(shape, *where), claim=0.0)


def poses_near(seed, n=5):
    rng = np.random.default_rng(seed)
    return se3.retract(standing(MUG), rng.normal(size=(n, 6)) * np.repeat([0.2, 0.03], 3))


def test_with_nothing_around_or_without_context_nothing_is_said():
    poses = poses_near(0)
    assert (Surroundings((), ()).log_potential(MODEL, MUG, poses) == 0.0).all()
    crowded = Surroundings((neighbour(1, BOX, 0.02),), (surface(0.0),))
    assert (crowded.log_potential(model_of(*NAMES, context=False), MUG, poses) == 0.0).all()
    assert (crowded.log_potential(MODEL, MUG, poses) != 0.0).any()
    assert (crowded.without(1).log_potential(MODEL, MUG, poses) == support_log_potential(
        MODEL, MUG, poses, crowded.supports)).all()  # fmt: skip


@settings(max_examples=15)
@given(st.integers(0, 2**31))
def test_moving_the_whole_world_changes_nothing(seed):
    """Law 4 of the model."""
    rng = np.random.default_rng(seed)
    G = se3.exp(rng.normal(size=6))
    around = Surroundings((neighbour(1, BOX, 0.05, 0.03), neighbour(2, CAN, -0.1)), (surface(0.0), surface(0.02, 0.2)))
    moved = Surroundings(
        tuple(replace(n, T_world_centre=G @ n.T_world_centre) for n in around.neighbours),
        tuple(s.moved(G) for s in around.supports),
    )
    poses = poses_near(seed)
    expected = around.log_potential(MODEL, MUG, poses)
    np.testing.assert_allclose(moved.log_potential(MODEL, MUG, G @ poses), expected, atol=1e-6)
    turned = Surroundings(around.neighbours[::-1], around.supports[::-1])
    np.testing.assert_allclose(turned.log_potential(MODEL, MUG, poses), expected, atol=1e-12)


@settings(max_examples=15)
@given(st.integers(0, 2**31))
def test_neighbours_say_together_what_each_says_alone(seed):
    others = (neighbour(1, BOX, 0.05, 0.03), neighbour(2, CAN, -0.1), neighbour(3, MUG, 0.3))
    alone = [Surroundings((n,), ()).log_potential(MODEL, CAN, poses_near(seed)) for n in others]
    together = Surroundings(others, ()).log_potential(MODEL, CAN, poses_near(seed))
    np.testing.assert_allclose(together, np.sum(alone, axis=0), atol=1e-12)


def test_two_things_in_one_place_are_impossible_and_side_by_side_they_are_not():
    inside, beside = standing(MUG, 0.02), standing(MUG, 0.2)
    around = Surroundings((neighbour(1, BOX),), ())
    assert (around.log_potential(MODEL, MUG, inside[None]) < -5.0).all()
    assert (around.log_potential(MODEL, MUG, beside[None]) > -1.0).all()
    outside = Surroundings((neighbour(1, MUG, 0.02),), ())
    assert (outside.log_potential(MODEL, BOX, standing(BOX)[None]) < -5.0).all()


def test_penetration_is_measured_in_metres_and_alike_from_both_sides():
    side = np.ptp(BOX.mesh.vertices, axis=0)[0]
    poses = se3.make(np.tile(np.eye(3), (3, 1, 1)), [[side - 0.02, 0.0, 0.0], [side + 0.01, 0.0, 0.0], [9.0, 0.0, 0.0]])
    depth = penetration_depth(BOX, BOX, poses)
    np.testing.assert_allclose(depth, [0.02, 0.0, 0.0], atol=0.003)
    np.testing.assert_allclose(penetration_depth(BOX, MUG, poses), penetration_depth(MUG, BOX, se3.inverse(poses)))


def test_a_thing_of_the_same_kind_nearby_is_welcome_and_a_stranger_is_nothing():
    near = standing(CAN)[None]
    kin, stranger = neighbour(1, BOX, 0.15), neighbour(2, MUG, 0.15)  # food and food, food and kitchen
    said = [Surroundings((n,), ()).log_potential(MODEL, CAN, near)[0] for n in (kin, stranger)]
    far = Surroundings((neighbour(1, BOX, 5.0),), ()).log_potential(MODEL, CAN, near)[0]
    assert said[0] > 0.1
    assert said[1] == pytest.approx(0.0, abs=1e-9)
    assert said[0] > far


@given(st.integers(0, 2**31))
def test_heights_above_surfaces_are_those_of_the_points_where_an_outline_holds_the_centre(seed):
    rng = np.random.default_rng(seed)
    outline = np.sort(rng.uniform(0.0, 2.0 * np.pi, 9))[:: rng.choice([-1, 1]), None]
    outline = np.concatenate([np.cos(outline), np.sin(outline)], axis=-1) * rng.uniform(0.05, 0.5, 2)
    planes = tuple(
        replace(surface(0.0), hull=outline).moved(se3.exp(rng.normal(size=6) * np.repeat([3.0, 0.1], 3)))
        for _ in range(3)
    )
    poses = se3.exp(rng.normal(size=(20, 6)) * np.repeat([2.0, 0.2], 3))
    low, high = heights_above(planes, MUG, poses)
    for p, plane in enumerate(planes):
        heights = se3.transform(poses, MUG.hull_points) @ plane.normal - plane.offset
        within = plane.contains(poses[:, :3, 3])
        np.testing.assert_array_equal(np.isneginf(low[p]), ~within)
        np.testing.assert_allclose(low[p][within], heights[within].min(axis=-1), rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(high[p][within], heights[within].max(axis=-1), rtol=0.0, atol=1e-12)


def height_potential(height, supports):
    return support_log_potential(MODEL, MUG, (se3.make(np.eye(3), height * UP) @ standing(MUG))[None], supports)[0]


def test_a_thing_stands_on_a_surface_may_float_at_a_price_and_doesnt_sink():
    ground = (surface(0.0),)
    assert height_potential(0.0, ground) == pytest.approx(0.0, abs=0.05)
    heights = np.linspace(0.0, 0.3, 7)
    floating = [height_potential(h, ground) for h in heights]
    assert (np.diff(floating) <= 1e-9).all()
    assert floating[-1] == pytest.approx(np.log(MODEL.config.context.other_support), abs=0.01)
    sinking = [height_potential(-h, ground) for h in np.linspace(0.0, 0.05, 6)]
    assert (np.diff(sinking) <= 1e-9).all()
    # the surface may not be there; nothing is charged more than that
    assert sinking[-1] == pytest.approx(np.log(MODEL.config.context.doubt), abs=0.1)


def test_the_surface_that_suits_best_counts_and_only_one_that_is_beneath():
    low, high = surface(-0.3), surface(0.0)
    assert height_potential(0.0, (low, high)) == pytest.approx(height_potential(0.0, (high,)), abs=1e-9)
    assert height_potential(0.0, (surface(0.0, x=3.0),)) == 0.0  # beside it
    assert height_potential(-1.0, (high,)) == 0.0  # wholly beneath: nothing to do with it


@pytest.mark.parametrize(("sigma", "share"), [(0.0, 0.05), (0.005, 0.5)])
def test_a_neighbours_pixels_are_its_own(sigma, share):
    """What a neighbour explains is no evidence for another object there, as far as its depth is known."""
    model = model_of(*NAMES, config=config_of(f"sensor.background_sigma_m={sigma}"))
    pose = standing(BOX)
    T_world_camera = looking(0.3, 0.9)
    observation = replace(view_of(model, [(BOX, pose)], T_world_camera), planes=())
    T = (observation.frame.T_camera_world @ pose)[None]
    proposer = Proposer(model)
    box = np.array(box_of(BOX, T[0]))
    alone = proposer.view(observation, box, None, Surroundings((), ()))
    claimed = proposer.view(observation, box, None, Surroundings((Neighbour(1, BOX, pose, 0.0),), ()))
    own, _ = proposer.score(BOX, alone, T)
    taken, _ = proposer.score(BOX, claimed, T)
    assert own[0] > 50.0
    assert taken[0] < share * own[0]


def test_a_surface_known_from_other_views_is_background_where_the_image_shows_none():
    T_world_camera = looking(0.3)
    observation = replace(view_of(MODEL, [], T_world_camera), planes=())
    proposer = Proposer(MODEL)
    box = np.array([100.0, 80.0, 60.0, 60.0])
    bare = proposer.view(observation, box, None, Surroundings((), ()))
    known = proposer.view(observation, box, None, Surroundings((), (surface(0.0),)))
    assert (bare.tile.background == 0).all()
    np.testing.assert_allclose(known.tile.background, known.tile.depth, atol=1e-4)


@settings(max_examples=15)
@given(st.integers(0, 2**31))
def test_the_outlook_is_the_box_that_is_rendered(seed):
    rng = np.random.default_rng(seed)
    T = se3.inverse(looking(rng.uniform(-3, 3), rng.uniform(0.6, 1.0))) @ standing(CAN, *rng.uniform(-0.1, 0.1, 2))
    seen = outlook(CAN, T, CAMERA)
    np.testing.assert_allclose(seen.box, box_of(CAN, T), atol=2.0)
    assert seen.share == 1.0


def test_what_is_behind_or_beside_the_camera_is_out_of_view():
    behind = se3.make(np.eye(3), np.array([0.0, 0.0, -1.0]))
    beside = se3.make(np.eye(3), np.array([5.0, 0.0, 1.0]))
    for T in (behind, beside):
        seen = outlook(MUG, T, CAMERA)
        assert seen.share == 0.0
        np.testing.assert_array_equal(seen.box, 0.0)
    half = se3.make(np.eye(3), np.array([-0.56, 0.0, 1.0]))  # the image ends at -0.56 m
    assert 0.2 < outlook(BOX, half, CAMERA).share < 0.8


def test_depth_of_a_scene_is_that_of_its_table():
    """The scenes of these tests are what they say."""
    T = looking(0.2)
    points = se3.transform(T, CAMERA.points(depth_of([], T))[100:140, 100:200].reshape(-1, 3))
    np.testing.assert_allclose(points[:, 2], 0.0, atol=1e-6)


def test_a_table_does_not_stand_on_its_own_top_but_a_mug_does():
    model = model_of("table", "mug")
    shape, mug = model.shapes[[s.source.name for s in model.shapes].index("table")], shape_named(model, "mug")
    pose = standing(shape)
    high = float(se3.transform(pose, shape.hull_points)[:, 2].max())
    size = np.ptp(shape.mesh.vertices, axis=0)[:2] / 2
    hull = size * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    top = Plane(np.array([0.0, 0, 1]), high, se3.make(np.eye(3), np.array([0.0, 0, high])), hull, 0.5)
    assert support_log_potential(model, shape, pose[None], (top,))[0] == 0.0
    lifted = se3.make(np.eye(3), np.array([0.0, 0.0, high])) @ standing(mug)
    sunk = se3.make(np.eye(3), np.array([0.0, 0.0, high - 0.03])) @ standing(mug)
    potential = support_log_potential(model, mug, np.stack([lifted, sunk]), (top,))
    assert potential[0] > -0.5
    assert potential[1] < -10.0


def test_a_face_of_ones_own_is_no_background_and_the_table_is():
    model = model_of("cereal_box")
    (box,) = model.shapes
    camera = looking(0.4, 0.75, 0.6)
    observation = view_of(model, [(box, standing(box))], camera)
    own = np.array(observation.frame.detections[0].box)
    behind = observation.planes_behind(own)
    assert len(behind) < len(observation.planes)
    up = camera[:3, :3].T @ UP
    assert any(p.normal @ up > 0.95 and abs(p.moved(camera).offset) < 0.01 for p in behind)
    everything = observation.planes_behind(np.zeros(4))
    assert everything == observation.planes


def level_patch(half_m, z):
    """A level patch before a camera that looks straight down on it."""
    hull = half_m * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    T = se3.make(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, z])
    return Plane(np.array([0.0, 0.0, -1.0]), -z, T, hull, 0.3)


@pytest.mark.parametrize("seen_of_it", [1.0, 0.6])
def test_a_plane_is_a_things_own_where_all_of_it_is_in_the_box_margin_aside(seen_of_it):
    top = level_patch(0.1 + PlaneSearch().margin_m, 0.8)  # outlines reach beyond what was seen
    half = 0.1 * CAMERA.fx / 0.8
    where = where_in_image(top, CAMERA)
    box = np.array([CAMERA.cx - half, CAMERA.cy - half, 2.0 * half * seen_of_it, 2.0 * half])
    assert reaches_beyond(top, where, box, CAMERA) == (seen_of_it < 1.0)
