"""Laws of the supports that moves are told with."""

from dataclasses import replace

import numpy as np
import pytest

from ctmap_gtsam.building import NO_SUPPORT, Tables, build_estimate
from ctmap_gtsam.config import Config
from ctmap_gtsam.frontend.standing import with_supports
from sequences import se3
from tests.ctmap_gtsam.scenes import frame_of, level, looking, model_of, run_of, shape_named, standing

MODEL = model_of("mug", "table")
MUG, TABLE = (shape_named(MODEL, name) for name in ("mug", "table"))
SURFACES = (level(-3.0, half=2.0), level(0.0, half=2.0))
TOP_M = float(np.ptp(TABLE.mesh.vertices[:, 2]))
"""height of the table"""
FLOOR, ON_TABLE = standing(MUG, 1.2, 0.9), standing(MUG, 0.1, 0.1)
ON_TABLE[2, 3] += TOP_M
VISITS = (0, 0, 1, 1)
IMAGE = np.zeros((240, 320), np.float32)


def estimate_of(mugs, *, table=1.0, exists=(1.0,) * 4, gaps=((1, 2),), up=(0.0, 0.0, 1.0)):
    """A mug at T_world_centre (4, 4) of each of four keyframes, row 1, and a table about the origin, row 0."""
    frames = [frame_of(k, looking(), IMAGE, visit=v, time_s=3600.0 * v + k) for k, v in enumerate(VISITS)]
    tables = Tables(2, len(mugs), len(MODEL.shapes))
    things = ((TABLE, [standing(TABLE)] * 4, [table] * 4), (MUG, mugs, exists))
    for row, (shape, poses, there) in enumerate(things):
        tables.class_probability[row] = np.eye(len(MODEL.shapes))[shape.index]
        tables.existence[row] = there
        for k, T in enumerate(poses):
            tables.mode(row, k, shape.source.obj_id, 0.0, shape.to_object(T), np.eye(6), np.zeros((6, 0)))
    for gap in gaps:
        tables.move(1, gap, 1.0, (0, 1))
    cameras = np.stack([frame.T_world_camera for frame in frames])
    sure = np.zeros((len(frames), 6, 6))
    run = run_of(MODEL.catalogue, frames)
    meta = {"up_world": None if up is None else list(up)}
    return build_estimate(run, Config(), "test", np.arange(4), [5, 7], tables, cameras, sure, meta)


def supports(estimate, surfaces=SURFACES, **how):
    moves = with_supports(estimate, MODEL, [surfaces] * 4, **how).moves
    return list(zip(moves.from_support.tolist(), moves.to_support.tolist(), strict=True))


def test_a_thing_stands_on_an_object_whose_top_is_there_or_on_a_level_surface():
    assert supports(estimate_of([ON_TABLE, ON_TABLE, FLOOR, FLOOR])) == [(0, -2)]
    assert supports(estimate_of([FLOOR, FLOOR, ON_TABLE, ON_TABLE])) == [(-2, 0)]


def test_an_objects_top_goes_before_the_surface_that_was_seen_of_it():
    surfaces = (*SURFACES, level(TOP_M))
    assert supports(estimate_of([ON_TABLE, ON_TABLE, FLOOR, FLOOR]), surfaces) == [(0, -2)]
    nowhere = estimate_of([ON_TABLE, ON_TABLE, FLOOR, FLOOR], table=0.1)
    assert supports(nowhere, surfaces) == [(-3, -2)]
    assert supports(nowhere) == [(NO_SUPPORT, -2)]


def test_what_floats_is_gone_or_knows_no_up_has_no_support():
    floating = se3.make(np.eye(3), np.array([0.0, 0.0, 0.2])) @ FLOOR
    assert supports(estimate_of([floating, floating, FLOOR, FLOOR])) == [(NO_SUPPORT, -2)]
    gone = estimate_of([FLOOR] * 4, exists=(1.0, 1.0, 0.2, 0.2))
    assert supports(gone) == [(-2, NO_SUPPORT)]
    assert supports(estimate_of([FLOOR] * 4, up=None)) == [(NO_SUPPORT, NO_SUPPORT)]


@pytest.mark.parametrize(("settled", "expected"), [(False, -2), (True, 0)])
def test_where_a_filter_sees_a_thing_go_is_where_it_is_when_the_visit_ends(settled, expected):
    late = estimate_of([FLOOR, FLOOR, FLOOR, ON_TABLE])
    assert supports(late, settled=settled) == [(-2, expected)]


def test_of_two_moves_in_a_visit_each_has_its_own_support():
    twice = estimate_of([FLOOR, FLOOR, ON_TABLE, FLOOR], gaps=((1, 2), (2, 3)))
    assert supports(twice, settled=True) == [(-2, 0), (0, -2)]


def test_supports_move_with_the_world():
    world = se3.exp(np.array([0.4, -0.9, 2.0, 1.0, 2.0, 3.0]))
    here = estimate_of([ON_TABLE, ON_TABLE, FLOOR, FLOOR])
    modes = replace(here.modes, T_world_object=world @ here.modes.T_world_object)
    there = replace(here, modes=modes, meta={**here.meta, "up_world": (world[:3, :3] @ [0.0, 0.0, 1.0]).tolist()})
    assert supports(there, tuple(s.moved(world) for s in SURFACES)) == supports(here)
