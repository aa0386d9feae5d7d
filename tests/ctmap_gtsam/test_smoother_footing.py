"""Laws of what stands flat: what is said of its tilt, and of what nothing is said."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmap_gtsam.model import Model
from ctmap_gtsam.smoothing.footing import footings
from ctmap_gtsam.smoothing.graph import Camera, Measured, build, smooth
from sequences import se3
from sequences.geometry import Plane
from sequences.types import LocalisationNoise
from tests.ctmap_gtsam.scenes import UP, classes, config_of, level, shape_named, standing

MODEL = Model(classes("mug", "cereal_box", "soup_can"), config_of("context.standing_tilt_rad=0.012"), context=True)
MUG, BOX, CAN = (shape_named(MODEL, name) for name in ("mug", "cereal_box", "soup_can"))


@dataclass
class Floor:
    """What a place says of where things stand."""

    up_world: np.ndarray | None = None
    surfaces: tuple[Plane, ...] = ()


FLOOR = Floor(UP, (level(0.0),))


def tilted(shape, rad, yaw=0.0, about=(1.0, 0.0, 0.0)):
    return standing(shape, yaw=yaw) @ se3.make(se3.so3_exp(rad * np.array(about)), np.zeros(3))


def found(T, shape, place=FLOOR, stays=None):
    return list(footings(T, [True] * len(T) if stays is None else stays, shape, place, MODEL))


@pytest.mark.parametrize("shape", [MUG, BOX, CAN], ids=lambda s: s.source.name)
@given(st.floats(-3.0, 3.0), st.floats(-0.02, 0.02))
@settings(max_examples=10)
def test_what_stands_on_a_surface_has_its_face_up(shape, yaw, tilt):
    (footing,) = found(np.stack([tilted(shape, tilt, yaw)] * 3), shape)
    np.testing.assert_array_equal(footing.rows, range(3))
    np.testing.assert_allclose(footing.level @ footing.level.T, np.eye(2), atol=1e-9)
    np.testing.assert_allclose(footing.level @ [0.0, 0.0, 1.0], 0.0, atol=0.01)


@pytest.mark.parametrize(
    ("T", "place"),
    [
        (tilted(MUG, 0.5), FLOOR),
        (standing(MUG), Floor(UP, ())),
        (standing(MUG), Floor(UP, (level(-0.2),))),
        (standing(MUG, x=2.0), FLOOR),
        (standing(MUG), Floor(None, ())),
    ],
    ids=["leaning", "nothing below", "in the air", "beside the table", "no way up"],
)
def test_what_leans_or_has_nothing_below_does_not_stand(T, place):
    assert not found(np.stack([T, T]), MUG, place)


def test_a_lying_can_may_roll():
    """Its axis is level; the turn about it is free, whichever each view has."""
    lying = [
        se3.make(se3.so3_exp([0.0, np.pi / 2, 0.0]) @ se3.so3_exp([0.0, 0.0, roll]), np.array([0.0, 0.0, 0.033]))
        for roll in (0.0, 1.0, 2.0)
    ]
    (footing,) = found(np.stack(lying), CAN)
    np.testing.assert_allclose(np.abs(footing.level), [[0.0, 0.0, 1.0]], atol=0.02)


def test_each_stretch_between_moves_is_judged_alone():
    T = np.stack([standing(MUG), standing(MUG), tilted(MUG, 0.5), tilted(MUG, 0.5), standing(MUG, 0.2)])
    stretches = found(T, MUG, stays=[False, True, False, True, False])
    assert [footing.rows.tolist() for footing in stretches] == [[0, 1], [4]]


def measured(T, n, covariance):
    return [Measured(k, 0.2 * k, 0, T, covariance, stays=k > 0) for k in range(n)]


def graph(n, tilt, place=FLOOR, model=MODEL):
    covariance = np.diag(np.repeat([0.02**2, 0.002**2], 3))
    objects = {0: (BOX, measured(tilted(BOX, tilt), n, covariance))}
    cameras = [Camera(np.eye(4), 0.2 * k, 0) for k in range(n)]
    built = build(model, cameras, LocalisationNoise(), objects, place=place)
    return built, smooth(built, model, n)


def tilt_of(smoothed, k):
    T, covariance = smoothed.objects[0][k]
    return float(np.arccos(T[2, 2])), float(np.sqrt(covariance[0, 0]))


def test_what_all_views_tilt_alike_is_set_upright_and_no_more_certain_than_the_floor_is_even():
    """The error that a visit's views share leaves a tilt open that no number of views closes."""
    tilt = 0.02
    (_, free), (built, held) = graph(6, tilt, Floor()), graph(6, tilt)
    assert built.count()["standing"] == 6
    assert tilt_of(free, 3)[0] == pytest.approx(tilt, rel=0.02)
    assert tilt_of(held, 3)[0] < 0.75 * tilt
    assert 0.4 * MODEL.config.context.standing_tilt_rad < tilt_of(held, 3)[1] < tilt_of(free, 3)[1]
    np.testing.assert_allclose(held.objects[0][3][0][:3, 3], free.objects[0][3][0][:3, 3], atol=1e-4)


def test_one_fact_at_one_time_is_one_fact_however_many_keyframes_say_it():
    """Within the time in which nothing can tip, n keyframes have 1/n of it each."""
    built, _ = graph(4, 0.01)
    terms = [batch.terms for batch in built.batches if batch.kind == "standing"]
    (whole,) = (t.keyframes.tolist() for t in terms)
    assert whole == [4, 4, 4, 4]


def test_without_context_nothing_is_known_of_the_floor():
    assert "standing" not in graph(3, 0.01, model=Model(MODEL.catalogue, MODEL.config, context=False))[0].count()


def test_less_even_floors_say_less():
    uneven = replace(MODEL.config, context=replace(MODEL.config.context, standing_tilt_rad=0.2))
    (_, strict), (_, loose) = graph(6, 0.02), graph(6, 0.02, model=Model(MODEL.catalogue, uneven, context=True))
    assert tilt_of(strict, 3)[0] < tilt_of(loose, 3)[0]
