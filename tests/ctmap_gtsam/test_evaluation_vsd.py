"""VSD on images small enough to count, and on a run."""

import numpy as np
import pytest

from ctmap_gtsam.evaluation import record
from ctmap_gtsam.evaluation.vsd import EVERY, SHARES, TOLERANCE_M, recall, vsd
from sequences.bop import load_run, load_truth
from tests.ctmap_gtsam import synthetic

FAR = np.inf
TAU = np.array([0.01, 0.03])


def row(*values):
    return np.array([values], dtype=float)


def test_the_true_pose_has_no_error():
    surface = row(1.0, 1.0, FAR)
    assert vsd(row(1.0, 1.0, 2.0), surface, surface, TAU).tolist() == [0, 0]


def test_depth_counts_by_the_tolerance():
    """Two pixels, 2 cm apart in one of them: wrong there at a tolerance of 1 cm, right at 3 cm."""
    assert vsd(row(1.0, 1.0), row(1.0, 1.02), row(1.0, 1.0), TAU).tolist() == [0.5, 0]


def test_pixels_that_one_alone_covers_are_wrong():
    """One in common, one more each: 2 of 3."""
    error = vsd(row(1.0, 1.0, 1.0), row(1.0, 1.0, FAR), row(FAR, 1.0, 1.0), TAU)
    np.testing.assert_allclose(error, [2 / 3, 2 / 3])


def test_what_is_hidden_does_not_count():
    """Something at half a metre is before the second pixel; only the first is compared."""
    scene = row(1.0, 0.5)
    assert vsd(scene, row(1.0, 1.3), row(1.0, 1.0), TAU).tolist() == [0, 0]
    assert vsd(row(0.5, 0.5), row(1.0, 1.0), row(1.0, 1.0), TAU).tolist() == [1, 1]  # nothing to see at all


def test_a_surface_is_visible_within_the_tolerance_and_where_nothing_was_measured():
    just, beyond = 1.0 + 0.9 * TOLERANCE_M, 1.0 + 1.1 * TOLERANCE_M
    gone = row(FAR, 1.0)
    assert vsd(row(1.0, 1.0), row(just, 1.0), gone, TAU).tolist() == [0.5, 0.5]
    assert vsd(row(1.0, 1.0), row(beyond, 1.0), gone, TAU).tolist() == [0, 0]
    assert vsd(row(0.0, 1.0), row(9.0, 1.0), gone, TAU).tolist() == [0.5, 0.5]


def test_an_estimate_behind_the_visible_true_surface_is_there_to_be_wrong():
    """It can't hide behind the very thing that it should be."""
    assert vsd(row(1.0), row(1.5), row(1.0), TAU).tolist() == [1, 1]


def test_recall_is_over_all_pairs():
    assert recall(np.zeros(10)) == 1
    assert recall(np.ones(10)) == 0
    assert recall(np.full(10, SHARES[4] - 1e-9)) == pytest.approx(0.6)
    assert recall(np.array([0.0] * 3 + [1.0] * 7)) == pytest.approx(0.3)


def test_on_a_run_it_is_asked_in_every_fifth_frame(tmp_path):
    run = load_run(synthetic.write_run(tmp_path / "run", frames=7, visits=2))
    truth = load_truth(run)
    asked = sum(len(visit.frames[::EVERY]) for visit in run.visits) * len(truth.objects)

    def values(**options):
        of = record(run, truth, "m", synthetic.estimate_of(run, truth, **options)).frames.vsd_recall
        return of[np.isfinite(of)]

    np.testing.assert_array_equal(values(), np.ones(asked))  # as 0.1 mm of depth's rounding is no error
    away = values(disturb=synthetic.shifted(0.2))
    np.testing.assert_array_equal(away, np.zeros(asked))
    assert 0.2 < values(disturb=synthetic.shifted(0.01)).mean() < 0.99
    wrong = values(class_of=lambda n, f: 9 if n == 0 else None)
    assert wrong.mean() == pytest.approx(2 / 3)
