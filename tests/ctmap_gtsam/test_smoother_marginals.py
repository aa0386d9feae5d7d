"""Marginals read clique by clique are those of gtsam.Marginals, and few cliques are held at once."""

import weakref
from itertools import pairwise
from math import log2

import gtsam
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ctmap_gtsam.smoothing.elimination import Blocks
from ctmap_gtsam.smoothing.marginals import covariances, joints

UNIT = gtsam.noiseModel.Unit.Create(6)


def block(rng):
    """(6, 6) of no small singular value, mostly."""
    return rng.normal(size=(6, 6)) + 3.0 * np.eye(6)


def forest(rng, lengths, biases=2):
    """Chains of variables with some that are shared along each: a root a chain. The linear graph, and its keys."""
    linear, keys = gtsam.GaussianFactorGraph(), []
    for own in np.split(np.arange(sum(lengths)), np.cumsum(lengths)[:-1]):
        chain = own.tolist()
        shared = [10**6 + chain[0] + 10**5 * j for j in range(biases)]
        for key in [chain[0], *shared]:
            linear.add(key, block(rng) * 10.0 ** rng.uniform(-2, 2), np.zeros(6), UNIT)
        for a, b in pairwise(chain):
            linear.add(a, block(rng), b, block(rng), np.zeros(6), UNIT)
            linear.add(b, block(rng), int(rng.choice(shared)), block(rng), np.zeros(6), UNIT)
        keys += chain + shared
    return linear, keys


def tree_of(linear):
    return linear.eliminateMultifrontal(gtsam.Ordering.ColamdGaussianFactorGraph(linear))


def values(keys):
    out = gtsam.Values()
    for key in keys:
        out.insert(key, np.zeros(6))
    return out


@given(st.integers(0, 2**31), st.lists(st.integers(1, 12), min_size=1, max_size=4), st.integers(1, 2))
def test_they_are_those_of_gtsam(seed, lengths, biases):
    rng = np.random.default_rng(seed)
    linear, keys = forest(rng, lengths, biases)
    assert len(tree_of(linear).roots()) >= len(lengths)
    whole = gtsam.Marginals(linear, values(keys))
    asked = rng.permutation(keys)[: rng.integers(1, len(keys) + 1)].tolist()
    read = covariances(Blocks([np.sort(keys)], lambda _: linear), asked)
    assert read.keys() == set(asked)
    for key, covariance in read.items():
        expected = whole.marginalCovariance(key)
        np.testing.assert_allclose(covariance, expected, rtol=0.0, atol=1e-9 * np.abs(expected).max())
        np.testing.assert_array_equal(covariance, covariance.T)


def test_variables_of_a_clique_are_known_together():
    linear, keys = forest(np.random.default_rng(0), [8, 5])
    whole = gtsam.Marginals(linear, values(keys))
    for joint in joints(tree_of(linear), keys):
        a, b = list(joint.rows)[-2:]
        pair = whole.jointMarginalCovariance([a, b])
        expected = np.block([[pair.at(i, j) for j in (a, b)] for i in (a, b)])
        np.testing.assert_allclose(joint.of([a, b]), expected, rtol=0.0, atol=1e-9 * np.abs(expected).max())


def test_few_cliques_are_held_at_once():
    linear, keys = forest(np.random.default_rng(0), [200, 100])
    held, most, met = weakref.WeakSet(), 0, []
    tree = tree_of(linear)
    for joint in joints(tree, keys):
        held.add(joint)
        most = max(most, len(held))
        met += joint.frontals
    assert sorted(met) == sorted(keys)
    assert most <= log2(tree.size()) + 2


def test_what_nobody_asks_for_is_not_walked_through():
    linear, keys = forest(np.random.default_rng(0), [20, 20])
    tree = tree_of(linear)
    met = [key for joint in joints(tree, [keys[0]]) for key in joint.frontals]
    assert keys[0] in met
    assert len(met) < len(keys) // 2 + 1
