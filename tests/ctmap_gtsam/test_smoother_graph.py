"""Laws of the smoother's graph: where all is linear and Gaussian it is the Rauch-Tung-Striebel smoother."""

from dataclasses import dataclass, replace

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmap_gtsam.frontend.proposer import FLAT_M, PROBED_M
from ctmap_gtsam.model import Model
from ctmap_gtsam.smoothing.graph import (
    Camera,
    Measured,
    bias_key,
    build,
    shared_flatness,
    smooth,
)
from ctmap_gtsam.smoothing.writing import free_axes
from factors import mixture
from factors.custom import FactorValueError
from factors.symmetry import residual
from sequences import se3
from sequences.types import LocalisationNoise
from tests.ctmap_gtsam.scenes import classes, config_of
from tests.factors.strategies import SYMMETRIES, random_image

CONFIG = config_of(
    "prediction.rotation_rate=1e-6",
    "prediction.translation_rate=0.003",
    "sensor.bias_rotation_rad=1e-6",
    "sensor.bias_translation_m=0.0015",
    "sensor.bias_surface_m=0",
    "sensor.bias_size=0",
    "smoother.tolerance=1e-12",
)
MODEL = Model(classes("mug"), CONFIG, context=False)
MUG = MODEL.shapes[0]
EXACT_M = 1e-5  # how well the graph takes a pose to be known that is recorded without error


@dataclass
class Problem:
    """Translations of one thing over keyframes: random times, visits, covariances; some keyframes unmeasured."""

    times: np.ndarray
    visits: np.ndarray
    measured: dict[int, tuple[np.ndarray, np.ndarray]]
    """keyframe -> z (3,) and R (3, 3)"""
    noise: LocalisationNoise

    def cameras(self):
        return [Camera(np.eye(4), float(t), int(v)) for t, v in zip(self.times, self.visits, strict=True)]

    def modes(self):
        out = []
        for k, (z, R) in self.measured.items():
            covariance = 1e-12 * np.eye(6)
            covariance[3:, 3:] = R
            pose = se3.make(np.eye(3), z)
            out.append(Measured(k, float(self.times[k]), int(self.visits[k]), pose, covariance, stays=bool(out)))
        return out

    def drift(self, k):
        """Camera error of keyframe k given that of k - 1: factor and fresh variance."""
        sigma = max(self.noise.translation_m, EXACT_M)
        if k == 0 or self.noise.translation_m == 0.0 or self.visits[k] != self.visits[k - 1]:
            return 0.0, sigma**2
        rho = np.exp(-(self.times[k] - self.times[k - 1]) / self.noise.correlation_time_s)
        return rho, sigma**2 * (1 - rho**2)


def some_problem(seed, noise=0.0, visits=2):
    rng = np.random.default_rng(seed)
    n = 10
    times = np.cumsum(rng.uniform(0.05, 1.5, n))
    measured = {}
    for k in range(n):
        if k == 0 or rng.random() < 0.7:
            A = rng.normal(size=(3, 3))
            measured[k] = 0.004 * rng.normal(size=3), 4e-6 * (A @ A.T / 3 + 0.1 * np.eye(3))
    located = LocalisationNoise(1e-9 * (noise > 0), noise, 2.0)
    return Problem(times, np.arange(n) * visits // n, measured, located)


def rauch_tung_striebel(problem):
    """Smoothed means and covariances of [thing, camera error, bias of each visit], 3 numbers each, by keyframe."""
    n_visits = int(problem.visits.max()) + 1
    size = 3 * (2 + n_visits)

    def block(i, j, value):
        M = np.zeros((size, size))
        M[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] = value
        return M

    bias = CONFIG.sensor.bias_translation_m**2
    # a thing at z seen from a camera that errs by e stands at z + e + b + noise; it is measured first at keyframe 0
    z, R = problem.measured[0]
    m = np.zeros(size)
    m[:3] = z
    e = problem.drift(0)[1]
    spread = sum(block(i, i, v * np.eye(3)) for i, v in enumerate([0.0, e, *[bias] * n_visits]))
    G = np.eye(size) + block(0, 1, np.eye(3)) + block(0, 2 + problem.visits[0], np.eye(3))
    P = G @ spread @ G.T + block(0, 0, R)
    filtered, predicted, moves = [(m, P)], [None], [None]
    for k in range(1, len(problem.times)):
        rho, fresh = problem.drift(k)
        dt = problem.times[k] - problem.times[k - 1]
        F = np.eye(size) + block(1, 1, (rho - 1.0) * np.eye(3))
        Q = block(0, 0, CONFIG.prediction.translation_rate**2 * dt * np.eye(3)) + block(1, 1, fresh * np.eye(3))
        m, P = F @ m, F @ P @ F.T + Q
        predicted.append((m, P))
        moves.append(F)
        if k in problem.measured:
            z, R = problem.measured[k]
            H = (block(0, 0, np.eye(3)) - block(0, 1, np.eye(3)) - block(0, 2 + problem.visits[k], np.eye(3)))[:3]
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
            m, P = m + K @ (z - H @ m), P - K @ H @ P
        filtered.append((m, P))
    out = [filtered[-1]]
    for k in range(len(problem.times) - 2, -1, -1):
        (m, P), (mp, Pp), (ms, Ps) = filtered[k], predicted[k + 1], out[0]
        C = P @ moves[k + 1].T @ np.linalg.inv(Pp)
        out.insert(0, (m + C @ (ms - mp), P + C @ (Ps - Pp) @ C.T))
    return out


def solved(problem, model=MODEL, shape=MUG):
    objects = {0: (shape, problem.modes())}
    built = build(model, problem.cameras(), problem.noise, objects)
    return built, smooth(built, model, len(problem.times))


@settings(max_examples=8)
@given(st.integers(0, 2**31), st.sampled_from([0.0, 0.002]), st.sampled_from([1, 2]))
def test_it_is_the_rauch_tung_striebel_smoother(seed, noise, visits):
    """Law 7 of the model: irregular times, missing measurements, random covariances, means and covariances to 1e-6."""
    problem = some_problem(seed, noise, visits)
    _, smoothed = solved(problem)
    assert smoothed.objects[0].keys() == problem.measured.keys()
    for k, (m, P) in enumerate(rauch_tung_striebel(problem)):
        if k in problem.measured:
            T, covariance = smoothed.objects[0][k]
            np.testing.assert_allclose(T[:3, 3], m[:3], atol=1e-8)
            np.testing.assert_allclose(covariance[3:, 3:], P[:3, :3], atol=1e-6 * P[:3, :3].max())
            np.testing.assert_allclose(T[:3, :3], np.eye(3), atol=1e-8)
        np.testing.assert_allclose(smoothed.T_world_camera[k][:3, 3], m[3:6], atol=1e-8)
        np.testing.assert_allclose(smoothed.camera_covariance[k][3:, 3:], P[3:6, 3:6], rtol=1e-5, atol=1e-14)
    assert smoothed.solution.end == "converged"


def test_a_thousand_views_of_one_visit_leave_the_bias():
    """Covariance saturates where errors are shared, and goes on shrinking with visits."""

    def sigma(n, visits):
        times, rng = 0.01 * np.arange(n), np.random.default_rng(0)
        measured = {k: (1e-4 * rng.normal(size=3), 1e-6 * np.eye(3)) for k in range(n)}
        still = replace(CONFIG, prediction=replace(CONFIG.prediction, translation_rate=1e-6))
        model = Model(classes("mug"), still, context=False)
        problem = Problem(times, np.arange(n) * visits // n, measured, LocalisationNoise())
        return np.sqrt(solved(problem, model)[1].objects[0][n // 2][1][3, 3])

    bias = CONFIG.sensor.bias_translation_m
    assert sigma(300, 1) == pytest.approx(bias, rel=0.02)
    assert sigma(300, 2) == pytest.approx(bias / np.sqrt(2), rel=0.02)


def views_with(spread, n):
    """n views of a still thing, a keyframe each, all of covariance `spread` (6, 6)."""
    cameras = [Camera(np.eye(4), 0.5 * k, 0) for k in range(n)]
    return cameras, [Measured(k, 0.5 * k, 0, np.eye(4), spread, stays=k > 0) for k in range(n)]


@pytest.mark.parametrize("n", [1, 4, 60])
def test_a_turn_that_no_view_shows_stays_open_however_many_there_are(n):
    exact = (
        "prediction.rotation_rate=1e-6",
        "sensor.bias_rotation_rad=1e-3",
        "sensor.bias_surface_m=0",
        "sensor.bias_size=0",
    )
    model = Model(classes("mug"), config_of(*exact), context=False)
    open_rad = PROBED_M / MUG.radius_m
    turn = se3.so3_exp(np.array([0.3, -0.5, 0.2]))[:, 2]
    spread = np.diag(np.repeat([0.02, 0.002], 3) ** 2)
    spread[:3, :3] += open_rad**2 * np.outer(turn, turn)
    cameras, measured = views_with(spread, n)
    objects = {0: (MUG, measured)}
    found = smooth(build(model, cameras, LocalisationNoise(0.0, 0.0, 1.0), objects), model, n)
    covariance = found.objects[0][0][1][:3, :3]
    assert np.sqrt(turn @ covariance @ turn) > 0.95 * open_rad
    across = np.cross(turn, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    assert np.sqrt(across @ covariance @ across) == pytest.approx(np.hypot(0.02 / np.sqrt(n), 1e-3), rel=0.02)


def test_views_that_show_all_share_no_flatness_and_one_that_shows_an_axis_closes_it():
    radius = MUG.radius_m
    precise, wide = np.repeat([0.02, 0.002], 3) ** 2, np.repeat([0.02, 0.002], 3) ** 2
    wide[2] = (PROBED_M / radius) ** 2
    assert not shared_flatness(np.stack([np.diag(precise)] * 5), radius).any()
    assert not shared_flatness(np.stack([np.diag(wide)] * 5 + [np.diag(precise)]), radius).any()
    alone = np.zeros(6)
    alone[2] = wide[2]
    np.testing.assert_allclose(shared_flatness(np.stack([np.diag(wide)] * 5), radius), np.diag(alone), atol=1e-12)


def test_a_move_cuts_the_track_and_what_is_left_shares_only_the_bias():
    problem = some_problem(3, visits=1)
    modes = problem.modes()
    cut = len(modes) // 2
    modes[cut] = replace(modes[cut], stays=False)
    objects = {0: (MUG, modes)}
    built = build(MODEL, problem.cameras(), problem.noise, objects)
    assert built.count()["prediction"] == len(modes) - 2
    shift = se3.make(np.eye(3), np.array([1.0, 0.0, 0.0]))
    moved = modes[:cut] + [replace(m, T_camera_centre=m.T_camera_centre @ shift) for m in modes[cut:]]
    other = build(MODEL, problem.cameras(), problem.noise, {0: (MUG, moved)})
    before, after = (smooth(b, MODEL, len(problem.times)) for b in (built, other))
    for i, m in enumerate(modes):
        shift = (after.objects[0][m.keyframe][0] - before.objects[0][m.keyframe][0])[0, 3]
        assert shift == pytest.approx(float(i >= cut), abs=1e-7)


def test_energies_by_kind_sum_to_the_graphs_error():
    """Law 5 of the model."""
    problem = some_problem(5, 0.002)
    built, smoothed = solved(problem)
    values = smoothed.solution.values
    assert sum(built.energy(values).values()) == pytest.approx(built.to_gtsam().error(values), abs=1e-9)
    assert set(built.energy(values)) == set(built.count()) == {"localisation", "bias", "measurement", "prediction"}
    n, kept = len(problem.times), len(problem.measured)
    assert built.count() == {"localisation": n, "bias": 2, "measurement": kept, "prediction": kept - 1}
    assert values.exists(bias_key(0, 0))


def tangled(seed, symmetry, count=5):
    """A thing of some symmetry: each measurement written in another of its equivalent poses."""
    rng = np.random.default_rng(seed)
    shape = replace(MUG, symmetry=symmetry)
    T = se3.make(se3.so3_exp(rng.normal(size=3)), np.array([0.1, -0.2, 0.8]))
    modes, plain = [], []
    for k in range(count):
        A = rng.normal(size=(6, 6)) / np.sqrt(6)
        scale = np.repeat([0.01, 0.002], 3)
        covariance = (A @ A.T + 0.2 * np.eye(6)) * scale[:, None] * scale
        if symmetry.order > 1 or symmetry.free:
            covariance = np.diag(scale**2)  # means the same in each of the equivalent poses
        seen = T @ se3.exp(rng.normal(size=6) * scale * 0.5)
        plain.append(Measured(k, 0.5 * k, 0, seen, covariance, k > 0))
        modes.append(replace(plain[-1], T_camera_centre=seen @ random_image(rng, symmetry)))
    cameras = [Camera(np.eye(4), 0.5 * k, 0) for k in range(count)]
    return shape, cameras, modes, plain, T


@pytest.mark.parametrize("name", ["none", "half turn", "box", "axis", "cylinder"])
def test_it_doesnt_matter_in_which_of_the_equivalent_poses_a_mode_is_written(name):
    symmetry = SYMMETRIES[name]
    about = replace(
        symmetry, offsets=0 * symmetry.offsets, discrete=np.where(np.arange(4) == 3, np.eye(4), symmetry.discrete)
    )
    config = config_of("smoother.tolerance=1e-12")
    model = Model(classes("mug"), config, context=False)
    shape, cameras, modes, plain, T = tangled(1, about)
    answers = []
    for some in (modes, plain):
        objects = {0: (shape, some)}
        built = build(model, cameras, LocalisationNoise(), objects)
        answers.append(smooth(built, model, len(cameras)))
    assert answers[0].solution.energy == pytest.approx(answers[1].solution.energy, abs=1e-6)
    for k in range(len(cameras)):
        r = residual(answers[0].objects[0][k][0], answers[1].objects[0][k][0], shape.symmetry)
        np.testing.assert_allclose(shape.symmetry.projection @ r, 0.0, atol=1e-5)
        near = shape.symmetry.projection @ residual(T, answers[0].objects[0][k][0], shape.symmetry)
        assert np.linalg.norm(near[-3:]) < 0.005


def test_moving_the_whole_world_moves_the_answer():
    """Law 4 of the model."""
    rng = np.random.default_rng(2)
    problem = some_problem(7, 0.002)
    G = se3.exp(rng.normal(size=6))
    objects = {0: (MUG, problem.modes())}
    here = problem.cameras()
    there = [replace(c, T_world_camera=G @ c.T_world_camera) for c in here]
    a, b = (smooth(build(MODEL, cameras, problem.noise, objects), MODEL, len(here)) for cameras in (here, there))
    for k in problem.measured:
        np.testing.assert_allclose(b.objects[0][k][0], G @ a.objects[0][k][0], atol=1e-7)
        np.testing.assert_allclose(b.objects[0][k][1], a.objects[0][k][1], rtol=1e-4, atol=1e-14)


def test_what_context_adds_is_one_fact_however_many_keyframes_share_it():
    """1/n a keyframe: the sum over keyframes is the potential once."""
    config = config_of("context.relations.same_category.strength=0.6", "smoother.tolerance=1e-12")
    model = Model(classes("soup_can", "cereal_box"), config)
    energies = []
    for n in (1, 2, 8):
        cameras = [Camera(np.eye(4), 0.5 * k, 0) for k in range(n)]
        objects = {
            i: (
                shape,
                [
                    Measured(k, 0.5 * k, 0, se3.make(np.eye(3), np.array([0.2 * i, 0, 0.8])), 1e-8 * np.eye(6), k > 0)
                    for k in range(n)
                ],
            )
            for i, shape in enumerate(model.shapes)
        }
        built = build(model, cameras, LocalisationNoise(), objects)
        assert built.count()["context"] == n
        energies.append(built.energy(built.initial)["context"])
    np.testing.assert_allclose(energies, energies[0], rtol=1e-9)
    assert energies[0] > 0.0
    without = Model(classes("soup_can", "cereal_box"), config, context=False)
    assert "context" not in build(without, cameras, LocalisationNoise(), objects).count()


def test_a_free_turn_is_marked_wide_and_the_rest_is_not():
    symmetry = SYMMETRIES["axis"]
    shape, cameras, modes, _, _ = tangled(4, replace(symmetry, offsets=0 * symmetry.offsets))
    model = Model(classes("mug"), config_of(), context=False)
    objects = {0: (shape, modes)}
    smoothed = smooth(build(model, cameras, LocalisationNoise(), objects), model, len(cameras))
    covariance = smoothed.objects[0][2][1]
    free = shape.symmetry.free_axes[:, 0]
    assert np.sqrt(free @ covariance @ free) > 0.5
    reduced = shape.symmetry.reduced_covariance(covariance)
    assert np.sqrt(np.diag(reduced)).max() < 0.05
    assert np.isfinite(mixture.log_constant(np.linalg.inv(reduced)))


@pytest.mark.parametrize("name", ["none", "box", "cylinder"])
def test_what_the_solver_takes_is_the_gtsam_graph(name):
    """Error and information matrix of the batches are those of one GTSAM factor each, at any values."""
    config = config_of("context.relations.same_category.strength=0.6")
    model = Model(classes("soup_can", "cereal_box"), config)
    rng = np.random.default_rng(3)
    objects = {}
    for i, shape in enumerate(model.shapes):
        plain = replace(SYMMETRIES[name], offsets=0 * SYMMETRIES[name].offsets)
        _, _, modes, _, _ = tangled(i, plain)
        objects[i] = (replace(shape, symmetry=plain), [replace(m, visit=m.keyframe // 3) for m in modes])
    cameras = [Camera(se3.exp(0.01 * rng.normal(size=6)), 0.5 * k, k // 3) for k in range(5)]
    built = build(model, cameras, LocalisationNoise(0.003, 0.004, 2.0), objects)
    graph, problem = built.to_gtsam(), built.problem()
    assert graph.size() == len(built.labels)
    assert [tuple(graph.at(i).keys()) for i in range(graph.size())] == [label.keys for label in built.labels]
    kinds = {"localisation", "bias", "measurement", "prediction", "context"} | (
        {"gauge"} if name == "cylinder" else set()
    )
    assert built.count().keys() == kinds
    step = gtsam.VectorValues()
    for key in built.initial.keys():  # noqa: SIM118
        step.insert(key, 0.02 * rng.normal(size=6))
    values = built.initial.retract(step)
    errors = [graph.at(i).error(values) for i in range(graph.size())]
    np.testing.assert_allclose(built.errors(values), errors, rtol=1e-9, atol=1e-12)
    assert problem.error(values) == pytest.approx(graph.error(values), rel=1e-12)
    ordering = gtsam.Ordering.ColamdNonlinearFactorGraph(graph)
    ours, theirs = (some.linearize(values).augmentedHessian(ordering) for some in (problem, graph))
    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9 * np.abs(theirs).max())


def test_a_number_that_is_none_is_an_error_that_names_its_factor():
    problem = some_problem(5)
    modes = problem.modes()
    broken = replace(modes[2], T_camera_centre=np.full((4, 4), np.nan))
    built = build(MODEL, problem.cameras(), problem.noise, {3: (MUG, [*modes[:2], broken, *modes[3:]])})
    with pytest.raises(FactorValueError, match=f"object 3 keyframe {modes[2].keyframe}"):
        built.problem().linearize(built.initial)


@pytest.mark.parametrize("name", ["axis", "cylinder"])
def test_how_wide_the_gauge_is_says_nothing_of_what_isnt_free(name):
    """And a free turn doesn't keep the solver from its optimum."""
    symmetry = replace(SYMMETRIES[name], offsets=0 * SYMMETRIES[name].offsets)
    discrete = symmetry.discrete.copy()
    discrete[:, :3, 3] = 0.0
    symmetry = replace(symmetry, discrete=discrete)
    shape, cameras, modes, _, _ = tangled(4, symmetry)
    model = Model(classes("mug"), config_of(), context=False)
    objects = {0: (shape, modes)}
    answers = []
    for sigma in (np.pi, 0.05):
        built = build(model, cameras, LocalisationNoise(0.003, 0.004, 2.0), objects)
        built._batches = [
            replace(batch, terms=replace(batch.terms, sigma_rad=sigma)) if batch.kind == "gauge" else batch
            for batch in built.batches
        ]
        answers.append(smooth(built, model, len(cameras)))
    assert [a.solution.end for a in answers] == ["converged"] * 2
    assert max(len(a.solution.trace) for a in answers) < 8
    P = symmetry.projection
    for k in range(len(cameras)):
        (T, covariance), (other, narrow) = (a.objects[0][k] for a in answers)
        np.testing.assert_allclose(P @ residual(T, other, symmetry), 0.0, atol=1e-6)
        expected = symmetry.reduced_covariance(covariance)
        np.testing.assert_allclose(symmetry.reduced_covariance(narrow), expected, atol=1e-3 * np.diag(expected).max())


@pytest.mark.parametrize("name", ["mug", "bowl"])
def test_free_axes_are_the_symmetrys_and_those_left_as_wide_as_a_score_that_shows_nothing(name):
    shape = Model(classes(name), CONFIG).shapes[0]
    unit = np.repeat([1.0 / shape.radius_m, 1.0], 3)
    close = np.diag((0.1 * FLAT_M * unit) ** 2)
    own = shape.symmetry.free_axes
    assert free_axes(shape, close).shape == own.shape
    lift = np.linalg.qr(np.concatenate([own, np.eye(6)], axis=1))[0][:, own.shape[1] :]
    open_to = unit * lift[:, 1] / np.linalg.norm(unit * lift[:, 1])
    left = close + (2.0 * FLAT_M) ** 2 * np.outer(unit * lift[:, 1], unit * lift[:, 1])
    found = free_axes(shape, left)
    assert found.shape == (6, own.shape[1] + 1)
    np.testing.assert_allclose(found.T @ found, np.eye(found.shape[1]), atol=1e-9)
    for column in (*own.T, open_to):
        np.testing.assert_allclose(found @ (found.T @ column), column, atol=1e-6)
    assert free_axes(shape, np.diag((3.0 * FLAT_M * unit) ** 2)).shape == (6, 3)
