"""Every object pose and robot pose of the run in one GTSAM graph.

Variables: x_k, the camera at keyframe k; o_ik, object i at keyframe k where a mode measures it; b_iv, the error that
all depth measurements of object i in visit v share, so that a thousand frames don't make a millimetre of bias certain.
Factors: measurement modes, prediction, context and gauge (of free rotations) from `factors`; localisation and the
prior on b_iv from here.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.frontend.company import Company, Partner
from ctmap_gtsam.frontend.place import Place
from ctmap_gtsam.frontend.proposer import FLAT_M, PROBED_M
from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import Shape
from ctmap_gtsam.smoothing.batched import BLOCK, Batch, Problem, padded
from ctmap_gtsam.smoothing.footing import footings
from ctmap_gtsam.smoothing.marginals import covariances
from ctmap_gtsam.smoothing.solver import Solution, optimise
from factors import symmetry
from factors.custom import stay_factor, terms_factor
from factors.terms import Contexts, Drifts, Gauges, Modes, Partners, Predictions, Standings
from sequences import se3
from sequences.types import LocalisationNoise

Array = NDArray[np.float64]

_EXACT = np.repeat([1e-5, 1e-5], 3)
"""rad, metres: how well a camera pose is known that is recorded without error"""
_STRIDE = 1_000_000
_KIND, _INDEX = 56, 2**56 - 1  # of a gtsam.Symbol: the bit at which its letter begins, and those of its index
_FURTHEST = 1e8  # ratio of variances of an object-visit's shared error


@dataclass(frozen=True)
class Measured:
    """The mode that the trellis chose for an object at a keyframe."""

    keyframe: int
    time_s: float
    visit: int
    T_camera_centre: Array
    """(4, 4)"""
    covariance: Array
    """(6, 6) of its right tangent"""
    stays: bool
    """whether it is the same place as at the object's measurement before"""


@dataclass(frozen=True)
class Camera:
    """A recorded camera pose."""

    T_world_camera: Array
    """(4, 4)"""
    time_s: float
    visit: int


@dataclass(frozen=True)
class Variable:
    """What a key stands for."""

    kind: str
    """x, o or b, as above"""
    row: int | None
    """the object; None for cameras"""
    index: int
    """the keyframe, or the visit of b"""

    @classmethod
    def of(cls, key: int) -> Variable:
        """The variable of a key of `camera_key`, `object_key` or `bias_key`."""
        symbol = gtsam.Symbol(key)
        kind, index = chr(symbol.chr()), symbol.index()
        return cls(kind, None, index) if kind == "x" else cls(kind, *divmod(index, _STRIDE))

    def __str__(self) -> str:
        """x<keyframe>, o<object>k<keyframe>, b<object>v<visit>."""
        return f"x{self.index}" if self.row is None else f"{self.kind}{self.row}{'kv'[self.kind == 'b']}{self.index}"


@dataclass(frozen=True)
class Label:
    """What a factor is."""

    kind: str
    """localisation, bias, measurement, prediction, context, standing, gauge, carried"""
    name: str
    keys: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Edges:
    """Factors that are a relative pose between two, with the error log(T^-1 T_a^-1 T_b)."""

    kind: str
    keys: NDArray[np.int64]
    """(n, 2) of a and b"""
    T: Array
    """(n, 4, 4)"""
    information: Array
    """(n, 6, 6) of the right tangent; nothing along free axes"""


@dataclass(eq=False)
class SmootherGraph:
    """The factors, the initial values, and what each factor is."""

    initial: Any = field(default_factory=gtsam.Values)
    """gtsam.Values"""
    objects: dict[int, str] = field(default_factory=dict)
    """object -> its class's name"""
    measured: dict[int, tuple[int, ...]] = field(default_factory=dict)
    """object -> the keyframes that it has a variable at, ascending"""
    _compiled: Any = field(default_factory=gtsam.NonlinearFactorGraph)
    _compiled_labels: list[Label] = field(default_factory=list)
    _batches: list[Batch] = field(default_factory=list)

    def add(self, kind: str, name: str, factor: Any) -> None:
        """Add a factor of GTSAM's own."""
        self._compiled.add(factor)
        self._compiled_labels.append(Label(kind, name, tuple(factor.keys())))

    def add_batch(self, batch: Batch) -> None:
        """Add factors of one form."""
        self._batches.append(batch)

    @property
    def batches(self) -> tuple[Batch, ...]:
        """The factors that are evaluated together."""
        return tuple(self._batches)

    @property
    def labels(self) -> list[Label]:
        """What each factor is, in the order of `to_gtsam`."""
        return self._compiled_labels + [
            Label(batch.kind, batch.name(keys), tuple(keys)) for batch in self._batches for keys in batch.keys.tolist()
        ]

    def problem(self, block: int = BLOCK) -> Problem:
        """The same as the solver takes it, which eliminates so many keyframes together, or more."""
        return Problem(self._compiled, self._batches, self.initial, keyframes_of, block)

    def to_gtsam(self) -> Any:
        """The same as a gtsam.NonlinearFactorGraph, with a CustomFactor for each that GTSAM has none for."""
        graph = gtsam.NonlinearFactorGraph()
        graph.push_back(self._compiled)
        for batch in self._batches:
            for i, keys in enumerate(batch.keys.tolist()):
                graph.add(terms_factor(batch.name(keys), keys, batch.terms[i]))
        return graph

    def count(self) -> dict[str, int]:
        """Number of factors by kind."""
        count = Counter(label.kind for label in self._compiled_labels)
        for batch in self._batches:
            count[batch.kind] += len(batch)
        return dict(count)

    def edges(self, values: Any) -> list[Edges]:
        """Measurements and predictions as relative poses, with symmetries and biases as they are at given values.

        A measurement's error is that of its edge to first order in the bias; without one they are equal.
        """
        return [
            *_between_edges(self._compiled, self._compiled_labels),
            *(
                _edges(batch, batch.terms, values)
                for batch in self._batches
                if isinstance(batch.terms, Modes | Predictions)
            ),
        ]

    def errors(self, values: Any) -> Array:
        """Each factor's error (n,) at given values in the order of `labels`, nats but for constants."""
        compiled = [self._compiled.at(i).error(values) for i in range(self._compiled.size())]
        return np.concatenate([compiled, *self.problem().batch_errors(values)])

    def contributions(self, values: Any) -> Contributions:
        """What each factor says at given values, in the order of `labels`."""
        kinds = [label.kind for label in self._compiled_labels]
        groups = [padded([label.keys for label in self._compiled_labels])]
        for batch in self._batches:
            kinds += [batch.kind] * len(batch)
            groups.append(batch.keys)
        begun = self._begun()
        objects = np.concatenate([_lowest_rows(keys) for keys in groups])
        return Contributions(
            kind=tuple(kinds),
            object=objects[:, 0],
            keyframe=np.concatenate([_latest(keys, begun) for keys in groups]),
            other=objects[:, 1],
            nats=-self.errors(values),
        )

    def _begun(self) -> dict[int, int]:
        """b_iv -> the keyframe of its first measurement."""
        begun: dict[int, int] = {}
        for batch in self._batches:
            if batch.kind == "measurement":
                for bias in np.unique(batch.keys[:, -1]).tolist():
                    first = int(keyframes_of(batch.keys[batch.keys[:, -1] == bias, 0]).min())
                    begun[bias] = min(first, begun.get(bias, first))
        return begun

    def energy(self, values: Any) -> dict[str, float]:
        """Error by kind at given values, nats."""
        return self.contributions(values).energy


@dataclass(frozen=True)
class Carried:
    """What measurements before a window of keyframes say of the variables that it begins with.

    These are the camera of the keyframe before it, each object at its last measurement before it, and the biases.
    """

    first: int
    """first keyframe of the window"""
    factors: Any
    """gtsam.GaussianFactorGraph"""
    at: Any
    """gtsam.Values that the factors are linear about"""


@dataclass(frozen=True)
class Contributions:
    """What each of n factors says at the solution: the graph's part of an estimate's ledger."""

    kind: tuple[str, ...]
    """(n,) as `Label` has it"""
    object: NDArray[np.int64]
    """(n,) -1 for cameras alone; the lower of a pair"""
    keyframe: NDArray[np.int64]
    """(n,) the later of two; of an object-visit's error that of its first measurement"""
    other: NDArray[np.int64]
    """(n,) the other object of a pair, else -1"""
    nats: Array
    """(n,) log potential relative to its greatest value: minus the factor's error"""

    @property
    def energy(self) -> dict[str, float]:
        """The factors' errors by kind, nats."""
        out: dict[str, float] = {}
        for kind, nats in zip(self.kind, self.nats.tolist(), strict=True):
            out[kind] = out.get(kind, 0.0) - nats
        return out


@dataclass(frozen=True)
class Smoothed:
    """The solution in arrays."""

    solution: Solution
    T_world_camera: Array
    """(K, 4, 4); of a window, from its first keyframe on"""
    camera_covariance: Array
    """(K, 6, 6)"""
    objects: Mapping[int, Mapping[int, tuple[Array, Array]]]
    """object -> keyframe -> T_world_centre (4, 4) and covariance (6, 6)"""
    contributions: Contributions
    """of each factor of the graph; their sum is minus its energy"""


def _between_edges(compiled: Any, labels: Sequence[Label]) -> list[Edges]:
    """GTSAM's own between factors."""
    out = []
    for kind in dict.fromkeys(label.kind for label in labels):
        those = [
            (label.keys, compiled.at(i))
            for i, label in enumerate(labels)
            if label.kind == kind and isinstance(compiled.at(i), gtsam.BetweenFactorPose3)
        ]
        if those:
            keys = np.array([k for k, _ in those])
            T = np.stack([factor.measured().matrix() for _, factor in those])
            roots = np.stack([factor.noiseModel().R() for _, factor in those])
            out.append(Edges(kind, keys, T, np.swapaxes(roots, -1, -2) @ roots))
    return out


def _edges(batch: Batch, terms: Modes | Predictions, values: Any) -> Edges:
    """r = log(T^-1 X g) - b of X = T_a^-1 T_b as an edge: Ad(g) r is about the error to T exp(b) g^-1."""
    S = terms.symmetry
    poses = [np.stack([values.atPose3(key).matrix() for key in column]) for column in batch.keys.T[:2].tolist()]
    X = se3.inverse(poses[0]) @ poses[1]
    if isinstance(terms, Modes):
        T, R = terms.T_camera_mode, terms.whitener
    else:
        T, R = np.broadcast_to(np.eye(4), X.shape), terms.whitener @ S.projection
    to_image = se3.inverse(symmetry.nearest_image(T, X, S)) @ X  # g^-1
    if batch.keys.shape[1] == 3:
        T = se3.retract(T, np.stack([values.atVector(key) for key in batch.keys[:, 2].tolist()]))
    root = R @ se3.adjoint(to_image)
    return Edges(batch.kind, batch.keys[:, :2], T @ to_image, np.swapaxes(root, -1, -2) @ root)


def camera_key(keyframe: int) -> int:
    """x_k."""
    return int(gtsam.symbol("x", keyframe))


def object_key(row: int, keyframe: int) -> int:
    """o_ik."""
    return int(gtsam.symbol("o", row * _STRIDE + keyframe))


def bias_key(row: int, visit: int) -> int:
    """b_iv."""
    return int(gtsam.symbol("b", row * _STRIDE + visit))


def name_of(keys: Sequence[int]) -> str:
    """What errors and tables call a factor of some keys: its objects and the latest of their keyframes, or cameras."""
    variables = [Variable.of(key) for key in keys]
    placed = [v for v in variables if v.kind == "o"]
    if not placed:
        return "cameras " + " and ".join(str(v.index) for v in variables)
    rows = [str(row) for row in sorted({v.row or 0 for v in placed})]
    return f"object{'s'[: len(rows) - 1]} {' and '.join(rows)} keyframe {max(v.index for v in placed)}"


def keyframes_of(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Keyframe of each of some keys (n,) of cameras and objects, -1 for b_iv."""
    index = keys & _INDEX
    kind = keys >> _KIND
    return np.where(kind == ord("x"), index, np.where(kind == ord("o"), index % _STRIDE, -1))


def _rows_of(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Object of each of some keys, -1 for cameras."""
    return np.where(keys >> _KIND == ord("x"), -1, (keys & _INDEX) // _STRIDE)


def _latest(keys: NDArray[np.int64], begun: Mapping[int, int]) -> NDArray[np.int64]:
    """(n,) the latest keyframe of each factor's variables, by keys (n, a); b_iv is of the one that it begins with."""
    keyframes = keyframes_of(keys)
    timeless = keyframes < 0
    keyframes[timeless] = [begun.get(key, 0) for key in keys[timeless].tolist()]
    return np.asarray(keyframes.max(axis=1, initial=0))


def _lowest_rows(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """(n, 2) the lowest two objects that each factor concerns, by its variables' keys (n, a); -1 for none."""
    none = np.iinfo(np.int64).max
    rows = _rows_of(keys)
    rows[rows < 0] = none
    first = rows.min(axis=1, initial=none)
    second = np.where(rows > first[:, None], rows, none).min(axis=1, initial=none)
    lowest = np.stack([first, second], axis=1)
    lowest[lowest == none] = -1
    return lowest


def build(
    model: Model,
    cameras: Sequence[Camera],
    noise: LocalisationNoise,
    objects: Mapping[int, tuple[Shape, Sequence[Measured]]],
    carried: Carried | None = None,
    company: Mapping[int, Company] | None = None,
    place: Place | None = None,
) -> SmootherGraph:
    """The graph of a run, or of a window of it.

    Args:
        model: potentials.
        cameras: one a keyframe.
        noise: of the recorded poses.
        objects: object -> its class and chosen modes in order of time; of those before a window, the last one where its
            variable is carried, else none.
        carried: what came before the window; None where it is the whole run. Cameras are given from the first of all.
        company: visit -> who was moved together; None = nobody.
        place: on which things stand; None = nowhere.
    """
    built = SmootherGraph()
    first = 0
    if carried is not None:
        first = carried.first
        built.initial.insert(carried.at)
        for i in range(carried.factors.size()):
            built.add("carried", f"before {first}", gtsam.LinearContainerFactor(carried.factors.at(i), carried.at))
    _add_cameras(built, cameras, noise, first)
    for row, (shape, measured) in objects.items():
        built.objects[row] = shape.source.name
        built.measured[row] = tuple(m.keyframe for m in measured)
        _add_object(built, model, row, shape, measured, cameras, place if model.context else None)
    if model.context:
        _add_context(built, model, objects, first, company or {})
    return built


def smooth(built: SmootherGraph, model: Model, n: int, first: int = 0) -> Smoothed:
    """Solve and take the marginals of the keyframes from `first` to n - 1."""
    settings = model.config.smoother
    problem = built.problem()
    solution = optimise(problem, built.initial, max_iterations=settings.max_iterations, tolerance=settings.tolerance)
    keys = [camera_key(k) for k in range(first, n)]
    keys += [object_key(row, k) for row, measured in built.measured.items() for k in measured]
    covariance_of = covariances(problem.blocks(solution.values), keys)
    del problem

    def read(key: int) -> tuple[Array, Array]:
        return solution.values.atPose3(key).matrix(), covariance_of[key]

    cameras = [read(camera_key(k)) for k in range(first, n)]
    poses = {row: {k: read(object_key(row, k)) for k in measured} for row, measured in built.measured.items()}
    T, covariance = (np.stack([camera[i] for camera in cameras]) for i in range(2))
    return Smoothed(solution, T, covariance, poses, built.contributions(solution.values))


def _add_cameras(built: SmootherGraph, cameras: Sequence[Camera], noise: LocalisationNoise, first: int) -> None:
    """Recorded poses with a stationary Gauss-Markov error a visit, e_k+1 = rho e_k + noise."""
    sigmas = np.repeat([noise.rotation_rad, noise.translation_m], 3)
    exact = not (sigmas > 0).all()
    sigmas = np.maximum(sigmas, _EXACT)
    drifting = []
    for k, camera in enumerate(cameras[first:], start=first):
        pose = gtsam.Pose3(camera.T_world_camera)
        built.initial.insert(camera_key(k), pose)
        if exact or k == 0 or cameras[k - 1].visit != camera.visit:
            model = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
            built.add("localisation", f"camera {k}", gtsam.PriorFactorPose3(camera_key(k), pose, model))
        else:
            drifting.append(k)
    if drifting:
        built.add_batch(_drifts(drifting, cameras, noise, sigmas))


def _drifts(drifting: Sequence[int], cameras: Sequence[Camera], noise: LocalisationNoise, sigmas: Array) -> Batch:
    """Factors between these keyframes and the ones before them."""
    before, after = ([cameras[k - step] for k in drifting] for step in (1, 0))
    dt = np.array([b.time_s - a.time_s for a, b in zip(before, after, strict=True)])
    rho = np.exp(-dt / max(noise.correlation_time_s, 1e-9))
    fresh = sigmas * np.sqrt(np.maximum(1.0 - rho**2, 1e-6))[:, None]
    recorded = [np.stack([c.T_world_camera for c in those]) for those in (before, after)]
    keys = np.array([(camera_key(k - 1), camera_key(k)) for k in drifting])
    return Batch("localisation", keys, Drifts(recorded[0], recorded[1], rho, fresh), name_of)


def _add_object(
    built: SmootherGraph,
    model: Model,
    row: int,
    shape: Shape,
    measured: Sequence[Measured],
    cameras: Sequence[Camera],
    place: Place | None,
) -> None:
    if not measured:
        return
    S = shape.symmetry
    recorded = np.stack([cameras[m.keyframe].T_world_camera for m in measured])
    T = recorded @ np.stack([m.T_camera_centre for m in measured])
    keys = np.array([object_key(row, m.keyframe) for m in measured])
    old = int(built.initial.exists(int(keys[0])))  # the first, where it is carried
    if old:
        T[0] = built.initial.atPose3(int(keys[0])).matrix()
    # one of the equivalent poses throughout: the bias lives in the object's tangent
    T = _one_image(T, S)
    if len(measured) > old:
        new = slice(old, None)
        _add_measurements(built, model, row, shape, measured[new], recorded[new], T[new], keys[new])
        if place is not None:
            _add_standing(built, model, shape, place, measured[new], T[new], keys[new])
    _add_predictions(built, model, S, measured, keys)


def _add_measurements(
    built: SmootherGraph,
    model: Model,
    row: int,
    shape: Shape,
    measured: Sequence[Measured],
    recorded: Array,
    T: Array,
    keys: NDArray[np.int64],
) -> None:
    for key, pose in zip(keys.tolist(), T, strict=True):
        built.initial.insert(key, gtsam.Pose3(pose))
    S = shape.symmetry
    for visit in dict.fromkeys(m.visit for m in measured):
        views = np.stack([m.covariance for m in measured if m.visit == visit])
        _add_bias(built, model, row, shape, visit, shared_flatness(views, shape.radius_m))
    seen_by = [(camera_key(m.keyframe), key, bias_key(row, m.visit)) for m, key in zip(measured, keys, strict=True)]
    information = np.linalg.inv(np.stack([m.covariance for m in measured]))
    modes = Modes(se3.inverse(recorded) @ T, information, S)
    built.add_batch(Batch("measurement", np.array(seen_by), modes, name_of))
    if S.free:
        built.add_batch(Batch("gauge", keys[:, None], Gauges(T, S), name_of))


def _add_standing(
    built: SmootherGraph,
    model: Model,
    shape: Shape,
    place: Place,
    measured: Sequence[Measured],
    T: Array,
    keys: NDArray[np.int64],
) -> None:
    """That it stands flat while it stays: a fact spread over the keyframes between which it can't have tipped."""
    up = place.up_world
    tilt = model.config.context.standing_tilt_rad
    as_one_s = (tilt / model.config.prediction.rotation_rate) ** 2
    for footing in footings(T, [m.stays for m in measured], shape, place, model):
        assert up is not None
        time_s = np.array([measured[i].time_s for i in footing.rows])
        # row by row: all pairs at once are the square of a long run
        shared = np.array([np.count_nonzero(np.abs(time_s - t) <= as_one_s) for t in time_s])
        sigma = np.full(len(shared), tilt)
        terms = Standings(footing.level, up, sigma, shared)
        built.add_batch(Batch("standing", keys[footing.rows, None], terms, name_of))


def _one_image(T: Array, S: symmetry.Symmetry) -> Array:
    """Each of the poses (n, 4, 4) written in the equivalent pose that is nearest to the one before."""
    out = [T[0]]
    for pose in T[1:]:
        out.append(symmetry.nearest_image(out[-1], pose, S))
    return np.stack(out)


def _add_predictions(
    built: SmootherGraph,
    model: Model,
    S: symmetry.Symmetry,
    measured: Sequence[Measured],
    keys: NDArray[np.int64],
) -> None:
    stays = [i for i in range(1, len(measured)) if measured[i].stays]
    if not stays:
        return
    dt = [max(measured[i].time_s - measured[i - 1].time_s, 1e-3) for i in stays]
    sigma = np.stack([model.prediction_covariance(t) for t in dt])
    if S.free or S.order > 1:
        pairs = np.stack([keys[[i - 1, i]] for i in stays])
        start = np.stack([built.initial.atPose3(key).matrix() for key in pairs[:, 0].tolist()])
        terms = Predictions(sigma, S, start if S.free else None)
        built.add_batch(Batch("prediction", pairs, terms, name_of))
        return
    for i, covariance in zip(stays, sigma, strict=True):
        pair = int(keys[i - 1]), int(keys[i])
        built.add("prediction", name_of(pair), stay_factor(*pair, covariance))


def shared_flatness(covariances: Array, radius_m: float) -> Array:
    """What no view of an object-visit shows, they all leave open alike: the variance (6, 6) of it that they share.

    A view's score is probed over a few centimetres of the surface. A covariance as wide as that is where the probe
    ended, and says nothing; a hundred such views say nothing, too.

    Args:
        covariances: (n, 6, 6) of the views, of the right tangent.
        radius_m: turns rad into metres of the surface.
    """
    unit = np.repeat([1.0 / radius_m, 1.0], 3)
    information, axes = np.linalg.eigh(np.linalg.inv(covariances / unit[:, None] / unit))
    told = np.einsum("nik,nk,njk->ij", axes, np.maximum(information - FLAT_M**-2.0, 0.0), axes)
    information, axes = np.linalg.eigh(told)
    flat = unit[:, None] * axes[:, information < PROBED_M**-2.0] * PROBED_M
    return np.asarray(flat @ flat.T)


def _add_bias(built: SmootherGraph, model: Model, row: int, shape: Shape, visit: int, flatness: Array) -> None:
    """The error that the measurements of an object-visit share: the depth's, and what none of them shows."""
    key = bias_key(row, visit)
    if built.initial.exists(key):
        return
    sigmas = model.bias_sigmas(shape)
    built.initial.insert(key, np.zeros(6))
    noise: Any = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    if flatness.any():
        # the root of diag(sigmas^2) + flatness, in units of the sigmas; not so far apart that elimination fails
        times, axes = np.linalg.eigh(np.eye(6) + flatness / sigmas[:, None] / sigmas)
        times = np.minimum(times, _FURTHEST)
        noise = gtsam.noiseModel.Gaussian.SqrtInformation((axes / np.sqrt(times)) @ axes.T / sigmas)
    built.add("bias", f"object {row} visit {visit}", gtsam.PriorFactorVector(key, np.zeros(6), noise))


def _add_context(
    built: SmootherGraph,
    model: Model,
    objects: Mapping[int, tuple[Shape, Sequence[Measured]]],
    first: int,
    company: Mapping[int, Company],
) -> None:
    """Context of pairs that are related, or were moved together: one fact spread over the keyframes that they share."""
    pairs = []
    for a, b in combinations(sorted(objects), 2):
        classes = objects[a][0].index, objects[b][0].index
        visits = {m.keyframe: m.visit for m in objects[a][1]}
        shared = [k for k in sorted({m.keyframe for m in objects[b][1]} & visits.keys()) if k >= first]
        n = len(shared)
        partners = {k: p for k in shared if (p := _partner(company.get(visits[k], {}), a, b, classes)) is not None}
        for one in {id(p): p for p in partners.values()}.values():
            _add_partners(built, model, (a, b), one, [k for k, p in partners.items() if p is one], n)
        if model.relations[classes].together > 0.0:
            pairs += [(a, b, k, n) for k in shared if k not in partners]
    if not pairs:
        return
    n = len(pairs)
    of = np.array([(objects[a][0].index, objects[b][0].index) for a, b, _, _ in pairs])
    related = model.relations[of[:, 0], of[:, 1]]
    centres, nothing = np.broadcast_to(0.0, (n, 2, 3)), np.broadcast_to(0.0, n)
    terms = Contexts(centres, related, nothing, np.array([shared for *_, shared in pairs]))
    keys = np.array([(object_key(a, k), object_key(b, k)) for a, b, k, _ in pairs])
    built.add_batch(Batch("context", keys, terms, name_of))


def _partner(company: Company, a: int, b: int, classes: tuple[int, int]) -> Partner | None:
    """What is known of a pair that was moved together, of these classes."""
    partner = company.get(a)
    return partner if partner is not None and partner.concerns(b, classes) else None


def _add_partners(
    built: SmootherGraph, model: Model, pair: tuple[int, int], partner: Partner, at: list[int], shared: int
) -> None:
    """Context of a pair in a visit in which it was moved together, at its keyframes, of all that it shares."""
    (a, c_a), (b, c_b) = list(zip(pair, partner.classes, strict=True))[:: 1 if partner.first else -1]
    n = len(at)
    related = model.relations[np.full(n, c_a), np.full(n, c_b)]
    symmetries = model.shapes[c_a].symmetry, model.shapes[c_b].symmetry
    terms = Partners(related, partner.relation, symmetries, np.full(n, float(partner.candidates)), np.full(n, shared))
    keys = np.array([(object_key(a, k), object_key(b, k)) for k in at])
    built.add_batch(Batch("context", keys, terms, name_of))
