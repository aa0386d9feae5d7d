"""What `ctmap bench render` measures is one thing done three ways."""

import json

import numba
import numpy as np
import pytest

from ctmap_gtsam.bench import render, run_bench
from ctmap_gtsam.config import Config, load_config
from sequences.rendering import RENDERERS
from sequences.rendering.rasteriser import Rasteriser

TASK = render.make_task(Config())


def test_the_fused_kernel_scores_what_is_rendered() -> None:
    """To the float32 of rendered images: the kernel itself keeps float64."""
    scores = render.rendered(TASK, Rasteriser())
    assert np.ptp(scores) > 100.0
    np.testing.assert_allclose(render.fused(TASK), scores, rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("name", [name for name in RENDERERS if name != "rasteriser"])
def test_references_see_and_score_the_same(name: str) -> None:
    renderer = RENDERERS[name]()
    if reason := renderer.available():
        pytest.skip(reason)
    figures = render.agreement(TASK, renderer)
    assert figures["agreement_mm_p99"] < 0.01
    assert figures["silhouette_share"] < 0.002
    assert figures["score_nats_p50"] < 0.01


def test_hypotheses_are_scored_alike_on_any_number_of_threads() -> None:
    threads = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        alone = render.fused(TASK)
    finally:
        numba.set_num_threads(threads)
    np.testing.assert_array_equal(render.fused(TASK), alone)


def test_the_task_depends_on_the_seed_alone() -> None:
    again, other = render.make_task(Config()), render.make_task(load_config(assignments=["seed=1"]))
    np.testing.assert_array_equal(again.T_camera_object, TASK.T_camera_object)
    np.testing.assert_array_equal(again.tile.depth, TASK.tile.depth)
    assert not np.array_equal(other.T_camera_object, TASK.T_camera_object)


def test_figures_of_a_reference_that_is_missing_are_null_and_say_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(render, "TURNS", 2)
    monkeypatch.setattr(render, "LEAST_SECONDS", 0.0)
    monkeypatch.setattr(RENDERERS["pyrender"], "available", lambda self: "no OpenGL here")
    figures = run_bench("render", Config())["figures"]
    assert figures["fused.hypotheses_per_s"] > 0
    assert figures["pyrender.hypotheses_per_s"] is None
    assert figures["fused.over_pyrender"] is None
    assert figures["pyrender.skipped"] == "no OpenGL here"
    json.dumps(figures, allow_nan=False)
