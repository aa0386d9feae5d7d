"""Laws of the marginal particle filter: densities are those of the draws, and where all is Gaussian it is Kalman's."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctmap_gtsam.filtering.particles import (
    Gaussians,
    Particles,
    Spread,
    kld_bound,
    occupied,
    predict,
    predicted_log_density,
    sufficient,
)
from ctmap_gtsam.filtering.reporting import Reporter
from ctmap_gtsam.filtering.updating import Updater
from ctmap_gtsam.frontend.association import Track
from ctmap_gtsam.frontend.landing import landing_log_density
from ctmap_gtsam.frontend.surroundings import Surroundings
from ctmap_gtsam.model import Model
from factors import mixture, prediction
from sequences import se3
from sequences.types import Detection, LocalisationNoise
from tests.ctmap_gtsam.gaussian import (
    MISSING,
    REFERENCE,
    SCALE,
    TIMES,
    GaussianProposer,
    begun,
    coordinates,
    measurements,
    observation_at,
)
from tests.ctmap_gtsam.scenes import classes, config_of, level, model_of
from tests.factors.strategies import SYMMETRIES, random_image

MUG = model_of("mug").shapes[0]
SHAPES = {  # about the centre frame's origin, as shapes have them
    name: replace(MUG, symmetry=replace(s, offsets=0 * s.offsets, discrete=_about_origin))
    for name, s in SYMMETRIES.items()
    for _about_origin in [np.where(np.arange(4) == 3, np.eye(4), s.discrete)]
}
each_shape = pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES.keys())
SEEDS = st.integers(0, 2**31)


def cloud(rng, shape, n=20, sigma=(0.05, 0.004), images=True):
    """Weighted particles about a pose, each written as some image of itself."""
    T = se3.retract(se3.exp(rng.normal(size=6)), rng.normal(size=(n, 6)) * np.repeat(sigma, 3))
    if images:
        T = np.stack([pose @ random_image(rng, shape.symmetry) for pose in T])
    return Particles(T, mixture.normalised(rng.normal(size=n)))


@each_shape
@settings(max_examples=8)
@given(SEEDS)
def test_the_predicted_density_is_the_mixture_of_the_prediction_potential(shape, seed):
    rng = np.random.default_rng(seed)
    particles, spread = cloud(rng, shape), Spread(0.03, 0.003)
    T = predict(particles, 10, spread, shape, rng)
    T = np.stack([pose @ random_image(rng, shape.symmetry) for pose in T])
    sigma = prediction.covariance(spread.rotation_rad**2, spread.translation_m**2, 1.0)
    each = prediction.log_potential(particles.T_world_centre[None], T[:, None], sigma, shape.symmetry)
    expected = mixture.log_sum(particles.log_weight + each)
    np.testing.assert_allclose(predicted_log_density(particles, T, spread, shape), expected, atol=0.05)


@each_shape
def test_what_is_drawn_has_the_density_that_is_stated(shape):
    """The mean of p / q over draws from q is the integral of p, 1, for the prediction and for proposals."""
    rng = np.random.default_rng(1)
    particles, spread = cloud(rng, shape), Spread(0.04, 0.004)
    A = rng.normal(size=(3, 6, 6)) * np.repeat([0.02, 0.002], 3)[:, None]
    proposals = Gaussians(
        particles.T_world_centre[:3],
        A @ A.swapaxes(-1, -2) + np.diag(np.repeat([0.03, 0.003], 3) ** 2),
        np.log([0.2, 0.5, 0.3]),
    )
    n = 3000
    T = np.concatenate([predict(particles, n, spread, shape, rng), proposals.draw(n, shape, rng)])
    p = predicted_log_density(particles, T, spread, shape)
    g = proposals.log_density(T, shape)
    q = np.logaddexp(p, g) - np.log(2.0)
    assert np.exp(p - q).mean() == pytest.approx(1.0, abs=0.05)
    assert np.exp(g - q).mean() == pytest.approx(1.0, abs=0.05)


def test_resampling_keeps_everyones_share():
    rng = np.random.default_rng(0)
    weights = rng.dirichlet(np.ones(7))
    particles = Particles(se3.exp(rng.normal(size=(7, 6))), np.log(weights))
    for uniform in (0.0, 0.3, 0.999):
        picked = particles.resampled(1000, uniform)
        counts = [(picked == T).all((1, 2)).sum() for T in particles.T_world_centre]
        np.testing.assert_allclose(counts, 1000 * weights, atol=1.0)


def test_the_heaviest_come_first_and_ties_in_order():
    T = np.tile(np.eye(4), (4, 1, 1))
    T[:, 0, 3] = np.arange(4)
    particles = Particles(T, np.log([0.2, 0.3, 0.3, 0.2]))
    np.testing.assert_array_equal(particles.best(4)[:, 0, 3], [1, 2, 0, 3])
    np.testing.assert_array_equal(particles.heaviest, particles.best(1)[0])
    assert Particles(T, np.full(4, np.log(0.25))).effective == pytest.approx(4.0)


@given(st.integers(0, 2**31), st.integers(1, 60))
def test_occupied_cells_are_different_rows(seed, n):
    cells = np.round(np.random.default_rng(seed).normal(scale=0.6, size=(n, 3)))
    assert occupied(cells) == len(np.unique(cells, axis=0))


@pytest.mark.parametrize("share", [0.5, 0.01], ids=["half proposed", "almost all predicted"])
def test_where_all_is_gaussian_the_filter_is_kalmans(share):
    """Law 7 of the model: means, covariances, evidence; irregular times, missing measurements, random covariances."""
    n = 9000  # at most: a third where all is in one place
    config = config_of(
        f"filter.particles={n}",
        f"filter.proposal_share={share}",
        "prediction.rotation_rate=0.02",
        "prediction.translation_rate=0.002",
        "prediction.jump_probability=1e-12",
    )
    model = Model(classes("mug"), config, context=False)
    measured, covariance = measurements(np.random.default_rng(5))
    updater = Updater(model, GaussianProposer(measured, covariance), LocalisationNoise())
    detection = Detection((100.0, 80.0, 60.0, 60.0), np.array([0.1, 0.9]))
    track = Track(0, (0,), (detection,), 0)
    mean, P, evidence = coordinates(measured[0]), covariance[0], model.log_uniform(model.shapes[0])
    belief = begun(updater, track, observation_at(0, detection))
    few = np.sqrt(n)
    for k in range(len(TIMES)):
        if k:
            belief = updater.step(belief, detection, observation_at(k, detection), Surroundings((), ()))
            P = P + model.prediction_covariance(TIMES[k] - TIMES[k - 1])
        if k and k not in MISSING:
            S = P + covariance[k]
            r = coordinates(measured[k]) - mean
            evidence += mixture.gaussian_log_density(r, np.linalg.inv(S))
            gain = P @ np.linalg.inv(S)
            mean, P = mean + gain @ r, P - gain @ P
        own = belief.classes[0]
        x, w = coordinates(own.particles.T_world_centre), np.exp(own.particles.log_weight)
        sigma = np.sqrt(np.diag(P))
        found = w @ x
        spread = (w[:, None] * (x - found)).T @ (x - found)
        few = min(few, np.sqrt(own.particles.effective))  # what was once lost stays lost
        np.testing.assert_allclose((found - mean) / sigma, 0.0, atol=5.0 / few)
        np.testing.assert_allclose(spread / np.outer(sigma, sigma), P / np.outer(sigma, sigma), atol=8.0 / few)
        assert own.log_evidence == pytest.approx(evidence, abs=0.1 * (k + 1))
    assert few > 15.0


def test_a_measurement_in_the_tail_of_the_prediction_is_met_half_way():
    """Seven sigma away, where hardly a particle is predicted: proposals reach it, and the prediction weighs them."""
    model = Model(
        classes("mug"), config_of("filter.particles=2000", "prediction.jump_probability=1e-12"), context=False
    )
    away = 5.0 * SCALE[3]
    far = se3.make(np.eye(3), REFERENCE[:3, 3] + [away, 0.0, 0.0])
    covariance = {k: np.diag(SCALE**2) for k in (0, 1)}
    updater = Updater(model, GaussianProposer({0: REFERENCE, 1: far}, covariance), LocalisationNoise())
    detection = Detection((100.0, 80.0, 60.0, 60.0), np.array([0.1, 0.9]))
    nothing = Surroundings((), ())
    belief = begun(updater, Track(0, (0,), (detection,), 0), observation_at(0, detection))
    belief = updater.step(belief, detection, observation_at(1, detection), nothing)
    prior = SCALE[3] ** 2 + model.prediction_covariance(0.3)[3, 3]
    particles = belief.classes[0].particles
    x = np.exp(particles.log_weight) @ particles.T_world_centre[:, 0, 3]
    assert x == pytest.approx(away * prior / (prior + SCALE[3] ** 2), abs=0.001)


@pytest.mark.parametrize("jump", [1e-12, 0.01])
def test_a_thing_that_jumped_is_found_as_likely_as_the_prior_says(jump):
    model = Model(classes("mug"), config_of(f"prediction.jump_probability={jump}"), context=False)
    far = se3.make(np.eye(3), REFERENCE[:3, 3] + [0.1, 0.0, 0.0])
    covariance = {k: np.diag(SCALE**2) for k in (0, 1)}
    updater = Updater(model, GaussianProposer({0: REFERENCE, 1: far}, covariance), LocalisationNoise())
    detection = Detection((100.0, 80.0, 60.0, 60.0), np.array([0.1, 0.9]))
    nothing = Surroundings((), ())
    start = begun(updater, Track(0, (0,), (detection,), 0), observation_at(0, detection))
    after = updater.step(start, detection, observation_at(1, detection), nothing)
    gained = after.classes[0].log_evidence - start.classes[0].log_evidence
    assert gained == pytest.approx(np.log(jump) + model.log_uniform(model.shapes[0]), abs=0.3)
    assert after.classes[0].particles.best(1)[0, 0, 3] == pytest.approx(0.1, abs=0.01)


def said_by(updater, belief, around):
    return Reporter(updater.model, updater.proposer, updater.localisation).report(belief, around)


@pytest.mark.parametrize("known", [True, False], ids=["known surface", "no surface"])
def test_a_thing_that_was_moved_while_nobody_looked_is_met_as_likely_as_it_lands_there(known):
    """Equation 3, with the smoother's density of the new place; and it is reported as a move, though in sight."""
    model = Model(classes("mug"), config_of("prediction.jump_probability=1e-12"), context=False)
    shape = model.shapes[0]
    far = se3.make(np.eye(3), REFERENCE[:3, 3] + [0.1, 0.0, 0.0])
    covariance = {k: np.diag(SCALE**2) for k in (0, 1)}
    updater = Updater(model, GaussianProposer({0: REFERENCE, 1: far}, covariance), LocalisationNoise())
    detection = Detection((100.0, 80.0, 60.0, 60.0), np.array([0.1, 0.9]))
    height = float(REFERENCE[2, 3] + shape.hull_points[:, 2].min())
    around = Surroundings((), (level(height),) if known else ())
    start = begun(updater, Track(0, (0,), (detection,), 0), observation_at(0, detection))
    after = updater.step(start, detection, observation_at(1, detection, 12 * 3600.0), around)
    gained = after.classes[0].log_evidence - start.classes[0].log_evidence
    moved = np.log(1.0 - model.stay_probability(shape.source, 12 * 3600.0))
    landing = landing_log_density(model, shape, far[None], around.supports, np.diag(SCALE**2)[None])[0]
    assert gained == pytest.approx(moved + landing, abs=0.3)
    assert (landing > model.log_uniform(shape) + 1.0) == known
    report = said_by(updater, after, around)
    assert report.moved > 0.99
    assert report.returned_ns == round(12 * 3600e9)
    stayed = Updater(model, GaussianProposer({0: REFERENCE, 1: REFERENCE}, covariance), LocalisationNoise())
    same = stayed.step(start, detection, observation_at(1, detection, 12 * 3600.0), around)
    assert said_by(stayed, same, around).moved < 0.01


def test_what_the_detector_says_of_a_thing_is_bounded_visit_by_visit():
    """Missed in all of one visit and found in the next: as `Model.seen_in_visit` weighs each."""

    class Witnessed(GaussianProposer):
        def witness(self, shape, view, T):
            return -4.0 if view.k < 4 else 2.0

    model = Model(classes("mug"), config_of(), context=False)
    updater = Updater(model, Witnessed({}, {}), LocalisationNoise())
    updater.proposer.measured = dict.fromkeys(range(6), REFERENCE)
    updater.proposer.covariance = {k: np.diag(SCALE**2) for k in range(6)}
    detection = Detection((100.0, 80.0, 60.0, 60.0), np.array([0.1, 0.9]))
    belief = begun(updater, Track(0, (0,), (detection,), 0), observation_at(0, detection, 0.0))
    for k in range(1, 6):
        seen = observation_at(k, detection, float(k))
        seen = replace(seen, frame=replace(seen.frame, visit=int(k >= 4)))
        belief = updater.step(belief, detection, seen, Surroundings((), ()))
    assert belief.witnessed(model) == pytest.approx(model.seen_in_visit(-16.0) + model.seen_in_visit(4.0))
    assert belief.witnessed(model) > np.log(model.config.detector.overlooked)


@pytest.mark.parametrize("jump", [1e-12, 0.01])
def test_no_measurement_takes_a_thing_farther_than_it_can_be_pushed(jump):
    """A box a metre away, with all the depth in the world, is another thing's."""
    model = Model(classes("mug"), config_of(f"prediction.jump_probability={jump}"), context=False)
    far = se3.make(np.eye(3), REFERENCE[:3, 3] + [1.0, 0.0, 0.0])
    covariance = {k: np.diag(SCALE**2) for k in (0, 1)}
    # localisation so bad that the prediction's Gaussian would reach there at a price that depth pays
    updater = Updater(model, GaussianProposer({0: REFERENCE, 1: far}, covariance), LocalisationNoise(0.0, 0.1))
    detection = Detection((100.0, 80.0, 60.0, 60.0), np.array([0.1, 0.9]))
    start = begun(updater, Track(0, (0,), (detection,), 0), observation_at(0, detection))
    after = updater.step(start, detection, observation_at(1, detection), Surroundings((), ()))
    away = after.classes[0].particles.T_world_centre[:, 0, 3]
    weights = np.exp(after.classes[0].particles.log_weight)
    assert weights[np.abs(away) > model.config.prediction.region_radius_m].sum() < 1e-12


@pytest.mark.parametrize("cells", [2, 5, 20, 100])
def test_so_many_draws_tell_a_histogram_over_cells(cells):
    """Less than 0.02 nats off with probability 0.99, whatever the histogram; 2 % of 4,000 trials are beyond chance."""
    rng = np.random.default_rng(cells)
    p = rng.dirichlet(np.full(cells, 20.0))
    q = rng.multinomial(kld_bound(cells), p, size=4000) / kld_bound(cells)
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.where(q > 0.0, q * np.log(q / p), 0.0).sum(axis=-1)
    assert (off < 0.02).mean() > 0.98


def test_more_cells_need_more_draws():
    bounds = [kld_bound(cells) for cells in range(1, 200)]
    assert bounds == sorted(bounds)


@each_shape
@settings(max_examples=8)
@given(SEEDS)
def test_what_a_belief_needs_hangs_neither_on_the_image_nor_on_the_world(shape, seed):
    rng = np.random.default_rng(seed)
    particles, frame = cloud(rng, shape, n=60, sigma=(0.2, 0.02), images=False), se3.exp(rng.normal(size=6))
    T = frame @ particles.T_world_centre
    images = np.stack([pose @ random_image(rng, shape.symmetry) for pose in T])
    there = sufficient(Particles(T, particles.log_weight), 300, shape)
    assert there == sufficient(particles, 300, shape)
    # what lies on a cell's edge may go either way, and the heaviest is written as another image of itself
    assert sufficient(Particles(images, particles.log_weight), 300, shape) == pytest.approx(there, rel=0.35)


@settings(max_examples=8)
@given(SEEDS)
def test_a_belief_in_one_place_needs_a_third_and_one_all_over_needs_all(seed):
    rng = np.random.default_rng(seed)
    assert sufficient(cloud(rng, MUG, n=300, sigma=(0.005, 3e-4)), 300, MUG) == 100
    assert sufficient(cloud(rng, MUG, n=300, sigma=(1.0, 0.1)), 300, MUG) == 300
