"""A linear-Gaussian world for the filter and what goes back over it: images that are Gaussians about measured poses."""

from dataclasses import dataclass

import numpy as np

from ctmap_gtsam.frontend.observation import Observation
from ctmap_gtsam.frontend.proposer import PoseModes
from ctmap_gtsam.frontend.scoring import Scores
from ctmap_gtsam.frontend.surroundings import Surroundings
from factors import mixture
from sequences import se3
from sequences.types import Detection
from tests.ctmap_gtsam.scenes import frame_of

REFERENCE = se3.make(np.eye(3), np.array([0.0, 0.0, 0.8]))
TIMES = np.array([0.0, 0.3, 1.0, 1.2, 2.5, 2.6, 4.0])
MISSING = (2, 5)
SCALE = np.repeat([0.02, 0.002], 3)


@dataclass(frozen=True)
class Look:
    """A view that is nothing but its keyframe."""

    detection: Detection | None
    k: int
    share: float

    def coarse(self):
        return self


@dataclass
class GaussianProposer:
    """A proposer whose images are Gaussians about measured poses; frames without one say nothing."""

    measured: dict[int, np.ndarray]
    covariance: dict[int, np.ndarray]

    def view(self, observation, box, detection, surroundings=None, share=1.0):
        return Look(detection, observation.keyframe, share)

    def search(self, shape, view, observation, surroundings, rng, share=1.0):
        return np.zeros((0, 4, 4))

    def modes(self, shape, view, starts, probe=True):
        k = view.k
        there = [k] if k in self.measured else []
        n = len(there)
        return PoseModes.of(
            np.array([self.measured[i] for i in there]).reshape(n, 4, 4),
            np.zeros(n),
            np.zeros(n),
            np.array([self.covariance[i] for i in there]).reshape(n, 6, 6),
            np.zeros(n),
        )

    def score(self, shape, view, T):
        if view.k not in self.measured:
            return np.zeros(len(T)), in_sight(len(T))
        r = coordinates(T) - coordinates(self.measured[view.k])
        return mixture.gaussian_log_density(r, np.linalg.inv(self.covariance[view.k])), in_sight(len(T))

    def near(self, shape, view, T, reach):
        return float(self.score(shape, view, T[None])[0][0])

    def log_clutter(self, shape, view, T, first):
        return 0.0

    def witness(self, shape, view, T):
        return 0.0

    def told(self, shape, view, T):
        return float(self.score(shape, view, T[None])[0][0]), 0.0


def in_sight(n):
    return Scores(np.zeros(n), np.ones(n), np.ones(n), np.zeros((n, 4)))


def coordinates(T):
    """Near the reference, poses are vectors: [rotation vector, translation]."""
    return np.concatenate([se3.so3_log(T[..., :3, :3]), T[..., :3, 3] - REFERENCE[:3, 3]], axis=-1)


def begun(updater, track, observation):
    """The belief of a new track that nothing surrounds."""
    nothing = Surroundings((), ())
    found = tuple(updater.search(track, shape, observation, nothing) for shape in updater.model.shapes)
    return updater.start(track, observation, nothing, found)


def observation_at(k, detection, time_s=None):
    time_s = TIMES[k] if time_s is None else time_s
    frame = frame_of(k, np.eye(4), np.zeros((240, 320), np.float32), [detection], time_s=time_s)
    return Observation(k, frame, frame.read_depth(), ())


def measurements(rng):
    """A measured pose with its covariance (6, 6) at all but the missing times."""
    measured, covariance = {}, {}
    for k in range(len(TIMES)):
        if k not in MISSING:
            A = rng.normal(size=(6, 6)) / np.sqrt(6)
            covariance[k] = (A @ A.T + 2.0 * np.eye(6)) * SCALE[:, None] * SCALE
            xi = rng.normal(size=6) * SCALE
            measured[k] = se3.make(se3.so3_exp(xi[:3]), REFERENCE[:3, 3] + xi[3:])
    return measured, covariance
