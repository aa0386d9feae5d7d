"""The laws of looking alike, and of the scores of what does."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmap_gtsam.evaluation.alike import ALIKE_M, Surface, confusable, look_alikes, surface_distance
from ctmap_gtsam.evaluation.frames import FrameErrors, class_metrics
from sequences import se3
from sequences.catalogue import Catalogue, Mesh
from sequences.simulation.shapes import catalogue as catalogue_of
from sequences.simulation.shapes import household
from tests.ctmap_gtsam import synthetic

NAMES = ("milk_carton", "shampoo_bottle", "soap", "computer_mouse", "book", "drill", "toilet_roll")


@pytest.fixture(scope="module")
def some() -> Catalogue:
    return catalogue_of(tuple(s for s in household() if s.object_class.name in NAMES))


def moved(mesh: Mesh, T: np.ndarray) -> Mesh:
    return replace(mesh, vertices=se3.transform(T, mesh.vertices))


def in_other_frames(catalogue: Catalogue, seed: int) -> Catalogue:
    rng = np.random.default_rng(seed)
    frames = [se3.make(se3.uniform_rotations(rng.random(3)), rng.normal(size=3)) for _ in catalogue.classes]
    return Catalogue(tuple(replace(c, mesh=moved(c.mesh, T)) for c, T in zip(catalogue.classes, frames, strict=True)))


def test_milk_and_shampoo_are_alike_and_a_book_is_like_nothing_here(some):
    names = [c.name for c in some.classes]
    alike = look_alikes(some)
    pairs = {frozenset((names[a], names[b])) for a, b in np.argwhere(alike)}
    assert frozenset(("milk_carton", "shampoo_bottle")) in pairs
    assert {"book", "drill"}.isdisjoint(frozenset().union(*pairs))
    assert confusable(some) == {some[o].obj_id for o in some.obj_ids if alike[some.index(o)].any()}


def test_alike_is_symmetric_and_nothing_is_like_itself(some):
    alike = look_alikes(some)
    assert np.array_equal(alike, alike.T)
    assert not alike.diagonal().any()


@pytest.mark.parametrize("seed", range(2))
def test_where_the_frames_of_meshes_lie_says_nothing(some, seed):
    assert np.array_equal(look_alikes(in_other_frames(some, seed)), look_alikes(some))


@settings(max_examples=10)
@given(st.integers(0, 2**32 - 1))
def test_a_mesh_laid_over_itself_is_nowhere_off(seed):
    rng = np.random.default_rng(seed)
    mesh = synthetic.solid(rng.uniform(0.03, 0.3, size=3))
    T = se3.make(se3.uniform_rotations(rng.random(3)), rng.normal(size=3))
    # the points looked up are some of those looked up in
    assert surface_distance(Surface(mesh), Surface(moved(mesh, T))) < 0.2 * ALIKE_M


def test_the_distance_of_concentric_boxes_is_that_of_their_faces():
    inner, outer = (Surface(synthetic.solid(np.full(3, side))) for side in (0.2, 0.21))
    # edges and corners of the outer one are further off, by root two and three at most
    assert surface_distance(inner, outer) >= 0.005
    assert surface_distance(inner, outer) < 0.0065
    assert surface_distance(inner, outer) == surface_distance(outer, inner)


def errors_of(confusing: np.ndarray, seed: int) -> FrameErrors:
    n = len(confusing)
    rng = np.random.default_rng(seed)
    nothing = np.full(n, np.inf)
    return FrameErrors(
        late=rng.random(n) < 0.5,
        situation=np.zeros(n, dtype=np.int64),
        confusable=confusing,
        class_id=np.ones(n, dtype=np.int64),
        class_correct=rng.random(n) < 0.5,
        class_probability=rng.random(n),
        class_square=2.0 * rng.random(n),
        **dict.fromkeys(
            ("translation_m", "rotation_rad", "mssd_m", "add_m", "adds_m", "mssd_recall", "mspd_recall", "vsd_recall"),
            nothing,
        ),
    )


SCORES = ("class_log_score", "class_brier_score")


def test_where_all_are_alike_the_scores_are_those_of_all():
    found = class_metrics(errors_of(np.ones(20, dtype=bool), 0))
    assert all(found[f"{name}_confusable"] == found[name] for name in SCORES)


def test_where_none_are_alike_there_is_no_score():
    found = class_metrics(errors_of(np.zeros(20, dtype=bool), 0))
    assert all(found[f"{name}_confusable"] is None for name in SCORES)


@given(st.lists(st.booleans(), min_size=2, max_size=30), st.integers(0, 99))
def test_scores_are_of_those_alone_and_of_any_order(chosen, seed):
    confusing = np.array(chosen)
    errors = errors_of(confusing, seed)
    found = class_metrics(errors)
    order = np.random.default_rng(seed).permutation(len(confusing))
    shuffled = class_metrics(errors.at(order))  # type: ignore[arg-type]
    alone = class_metrics(errors.at(confusing))
    for name in SCORES:
        assert shuffled[f"{name}_confusable"] == pytest.approx(found[f"{name}_confusable"])
        assert alone[name] == found[f"{name}_confusable"]
