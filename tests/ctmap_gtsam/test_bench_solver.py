"""What `ctmap bench solver` measures is one problem solved three ways."""

import json

import numpy as np
import pytest

from ctmap_gtsam.bench import run_bench, solver
from ctmap_gtsam.config import Config, load_config

CONFIG = load_config(assignments=["smoother.tolerance=1e-12"])
TASK = solver.make_task(Config(), 50)


def test_all_three_have_the_same_optimum():
    built, (graph, values) = TASK.graph(), solver.cpp_graph(TASK)
    ours = solver.ours(built, CONFIG)
    for others in (
        solver.gtsam_lm(graph, values, CONFIG),
        solver.gtsam_lm(built.to_gtsam(), built.initial, CONFIG),
    ):
        turned, moved = solver.apart(ours, others)
        assert turned < 1e-6
        assert moved < 1e-6
    assert graph.error(values) == pytest.approx(built.problem().error(built.initial), rel=1e-9)
    start = solver.apart(ours, built.initial)
    assert min(start) > 1e-3


def test_a_task_has_as_many_poses_as_asked_and_depends_on_the_seed_alone():
    assert solver.cpp_graph(TASK)[1].size() == 50
    again, other = solver.make_task(Config(), 50), solver.make_task(load_config(assignments=["seed=1"]), 50)
    modes = [t.objects[2][1][3].T_camera_centre for t in (TASK, again, other)]
    np.testing.assert_array_equal(modes[0], modes[1])
    assert not np.array_equal(modes[0], modes[2])


def test_what_drifts_is_another_problem():
    drifting = solver.make_task(Config(), 50, drifting=True)
    turned, moved = solver.apart(solver.ours(TASK.graph(), CONFIG), solver.ours(drifting.graph(), CONFIG))
    assert max(turned, moved) > 1e-4


def test_figures_say_how_long_and_how_far_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(solver, "TURNS", 1)
    monkeypatch.setattr(solver, "POSES", 25)
    monkeypatch.setattr(solver, "SIZES", (25, 50))
    figures = run_bench("solver", Config())["figures"]
    for name in ("ours", "smoother", "gtsam_lm_custom", "gtsam_lm_cpp"):
        assert figures[f"{name}.s"] > 0
    assert figures["ours.over_gtsam_lm_cpp"] == pytest.approx(figures["ours.s"] / figures["gtsam_lm_cpp.s"])
    assert figures["gtsam_lm_custom.over_ours"] == pytest.approx(figures["gtsam_lm_custom.s"] / figures["ours.s"])
    assert figures["ours.growth"] == pytest.approx(0.5 * figures["ours.s_50"] / figures["ours.s_25"])
    assert figures["ours.apart_mm"] < 0.1
    json.dumps(figures, allow_nan=False)
