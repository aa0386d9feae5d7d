"""Equation 3 in the filter: what it says of an absence hangs on how long it was, not on how often nobody looked."""

import numpy as np
import pytest

from ctmap_gtsam.filtering.filter import filter_run
from factors.persistence import stay_probability
from sequences import se3
from tests.ctmap_gtsam.scenes import (
    CAMERA,
    CHEAP,
    config_of,
    depth_of,
    detection_of,
    frame_of,
    looking,
    model_of,
    run_of,
    standing,
)

HOUR, WEEK = 3600.0, 7 * 24 * 3600.0
CONFIG = config_of(*CHEAP, "filter.particles=2000")
MONTE_CARLO = 0.02  # of a step that measures nothing: the mean of as many weights
MODEL = model_of("mug")
MUG = MODEL.shapes[0]
NOTHING = np.zeros((CAMERA.height, CAMERA.width), np.float32)


def moved(gap_s, steps):
    """P(it is elsewhere) once its place is in view again, in an image that measures nothing, and the run's estimate.

    A mug is seen for a while; then the camera looks the other way for `steps` keyframes, evenly spread over the gap.
    """
    T = standing(MUG)
    frames = []
    for k in range(4):
        camera = looking(0.1 * k, 0.75)
        seen = detection_of(MUG, se3.inverse(camera) @ T, 1)
        frames.append(frame_of(k, camera, depth_of([(MUG, T)], camera), [seen], time_s=0.5 * k))
    away = looking(0.4, 0.75) @ se3.make(se3.so3_exp(np.array([0.0, np.pi, 0.0])), np.zeros(3))
    begin = 1.5
    for k in range(1, steps):
        frames.append(frame_of(len(frames), away, NOTHING, time_s=begin + gap_s * k / steps))
    frames.append(frame_of(len(frames), looking(0.4, 0.75), NOTHING, time_s=begin + gap_s))
    estimate = filter_run(run_of(MODEL.catalogue, frames), CONFIG)
    (probability,) = estimate.moves.probability
    return float(probability), estimate


@pytest.mark.parametrize("gap_s", [6 * HOUR, 24 * HOUR])
def test_whether_a_thing_stayed_hangs_on_the_gap_and_not_on_how_many_keyframes_it_has(gap_s):
    stayed = [1.0 - moved(gap_s, steps)[0] for steps in (1, 10, 100)]
    expected = float(stay_probability(gap_s, MUG.source.persistence_s))
    np.testing.assert_allclose(stayed, expected, atol=MONTE_CARLO)


def test_a_thing_left_alone_for_a_week_has_half_stayed_and_half_moved():
    probability, estimate = moved(WEEK, 1)
    assert probability == pytest.approx(0.5, abs=MONTE_CARLO)
    # half of what was believed is gone from the place, too
    assert estimate.existence[0, -1] == pytest.approx(0.5, abs=2 * MONTE_CARLO)
