"""Objects of a smoothed map made by hand: a mug that was looked at in two visits a day apart."""

from types import SimpleNamespace

import numpy as np

from ctmap_gtsam.frontend.proposer import PoseModes
from ctmap_gtsam.smoothing.belief import judge
from ctmap_gtsam.smoothing.modes import Sighting
from sequences import se3
from sequences.types import Detection, LocalisationNoise
from tests.ctmap_gtsam.scenes import model_of

MODEL = model_of("mug")
HERE, THERE = (se3.make(np.eye(3), np.array([x, 0.0, 0.8])) for x in (0.0, 0.6))
DAY = 86400.0
BOX = Detection((10.0, 10.0, 40.0, 40.0), np.array([0.1, 0.9]))
SEEN, EMPTY = 60.0, -40.0
"""log-likelihoods of a pose where the thing is, and where it should show and doesn't"""
RECORDING = SimpleNamespace(
    keyframes=np.arange(8),
    run=SimpleNamespace(localisation=LocalisationNoise(1e-4, 1e-4)),
    place=SimpleNamespace(surfaces=()),
    T_world_camera=lambda k: np.eye(4),
    visit=lambda k: k // 4,
    time_s=lambda k: (k // 4) * DAY + k,
)
"""two visits of four keyframes, a day apart"""


def thing(object_id, *looks):
    """An object of looks: keyframe, pose or poses, nats; it has a box where it is seen."""
    covariance = np.diag(np.repeat([1e-4, 1e-6], 3))

    def sighting(k, T, nats):
        value = np.atleast_1d(nats)
        spread = np.broadcast_to(covariance, (len(value), 6, 6))
        modes = PoseModes.of(T.reshape(-1, 4, 4), value, value, spread, np.where(value > 0, 2.0, -2.0))
        return Sighting(k, (modes,), (np.zeros(len(value)),), 0.0)

    boxes = {k: BOX for k, _, nats in looks if np.max(nats) > 0}
    return judge(object_id, boxes, {k: sighting(k, T, nats) for k, T, nats in looks}, RECORDING, MODEL)


def stays(object_id, T, keyframes, nats=SEEN):
    return thing(object_id, *((k, T, nats) for k in keyframes))
