"""Laws of the spread: what changes is the seed alone, and a disturbed camera errs as its run says."""

from types import SimpleNamespace

import numpy as np
import pytest

from ctmap_gtsam.bench import spread
from ctmap_gtsam.config import Config
from ctmap_gtsam.evaluation.record import pooled, record
from sequences import se3
from sequences.bop import load_run
from sequences.errors import InputError
from sequences.truth import load_truth
from sequences.types import LocalisationNoise
from tests.ctmap_gtsam import synthetic
from tests.ctmap_gtsam.scenes import small_run


def test_the_extremes_hold_the_median_and_what_no_table_has_is_left_out():
    tables = [
        {"a": 1.0, "b": None, "c": float("nan")},
        {"a": 5.0, "b": None, "c": 2.0},
        {"a": 2.0, "b": None, "c": 3.0},
    ]
    told = spread.spread(tables)
    assert told == {"a.median": 2.0, "a.low": 1.0, "a.high": 5.0, "c.median": 2.5, "c.low": 2.0, "c.high": 3.0}


def test_a_paired_difference_is_of_the_object_frames_that_both_name_rightly():
    """Each frame is held to itself: a method that is worse by a millimetre everywhere is so, however errors scatter."""
    rng = np.random.default_rng(0)
    mssd, right = rng.uniform(0.0, 0.1, 50), rng.random(50) < 0.7
    a = SimpleNamespace(mssd_m=mssd, class_correct=right)
    b = SimpleNamespace(mssd_m=np.where(right, mssd + 1e-3, 9.0), class_correct=np.ones(50, dtype=bool))
    b.mssd_m[np.flatnonzero(right)[0]] = np.inf
    assert spread.paired(a, b) == pytest.approx(1.0)
    assert spread.paired(b, a) == pytest.approx(-1.0)
    assert spread.paired(a, SimpleNamespace(mssd_m=mssd, class_correct=~right)) is None


def test_a_disturbed_camera_errs_by_what_its_run_says_and_another_in_each_seed():
    run, _ = small_run(frames=6)
    noise = LocalisationNoise(0.03, 0.02, 1e-3)
    errors = np.concatenate(
        [
            se3.log(se3.inverse(a.T_world_camera) @ b.T_world_camera)[None]
            for seed in range(200)
            for a, b in zip(run.frames, spread.disturbed(run, noise, seed).frames, strict=True)
        ]
    )
    np.testing.assert_allclose(errors[:, :3].std(), 0.03, rtol=0.1)
    np.testing.assert_allclose(errors[:, 3:].std(), 0.02, rtol=0.1)
    again, other = spread.disturbed(run, noise, 1), spread.disturbed(run, noise, 2)
    first = spread.disturbed(run, noise, 1).frames[0].T_world_camera
    np.testing.assert_array_equal(again.frames[0].T_world_camera, first)
    assert np.abs(other.frames[0].T_world_camera - first).max() > 1e-6
    assert again.localisation == noise


def test_over_seeds_of_a_method_without_chance_nothing_spreads(tmp_path):
    path = synthetic.write_run(tmp_path / "small", frames=3, visits=1)
    figures = spread.run(Config(), runs=(path,), methods=("detector",), seeds=2)
    judged = pooled([record(load_run(path), load_truth(load_run(path)), "detector", None)])
    assert figures["detector.small.map_50.median"] == judged["map_50"]
    for name in {key.rsplit(".", 1)[0] for key in figures}:
        assert figures[f"{name}.low"] == figures[f"{name}.high"] == figures[f"{name}.median"]


def test_a_run_without_truth_and_none_at_all_are_refused(tmp_path):
    with pytest.raises(InputError, match="no recording"):
        spread.run(Config())
    path = synthetic.write_run(tmp_path / "small", frames=2, visits=1)
    for file in path.rglob("scene_gt.json"):
        file.unlink()
    with pytest.raises(InputError, match="no truth"):
        spread.run(Config(), runs=(path,))
