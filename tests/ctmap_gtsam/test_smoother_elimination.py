"""A run that is eliminated in blocks is the run that is eliminated at once, and no more of it is held than a block."""

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctmap_gtsam.bench.solver import make_task
from ctmap_gtsam.config import Config
from ctmap_gtsam.smoothing.batched import cut
from ctmap_gtsam.smoothing.elimination import Blocks
from ctmap_gtsam.smoothing.graph import keyframes_of
from ctmap_gtsam.smoothing.marginals import covariances
from ctmap_gtsam.smoothing.solver import optimise

UNIT = gtsam.noiseModel.Unit.Create(6)


def tangle(rng, n):
    """A chain of n variables, some that are shared along it, and leaps: factors' keys, and which block each is in."""
    factors = [(k, k + 1) for k in range(n - 1)]
    factors += [(k, n + int(rng.integers(3))) for k in range(n) if rng.random() < 0.7]
    factors += [tuple(rng.choice(n, size=2, replace=False).tolist()) for _ in range(int(rng.integers(3)))]
    factors += [(key,) for key in range(n + 3)]
    begins = np.sort(rng.integers(0, int(rng.integers(1, 6)), size=n))
    return factors, np.concatenate([np.unique(begins, return_inverse=True)[1], [-1, -1, -1]])


def in_blocks(rng, factors, first):
    """The linear system of such factors with random numbers, whole and in blocks."""
    groups = [np.array([f for f in factors if len(f) == size]) for size in (1, 2)]
    blocks, last = cut(first, groups)
    parts = [gtsam.GaussianFactorGraph() for _ in range(last.max() + 1)]
    whole = gtsam.GaussianFactorGraph()
    for group, own in zip(groups, blocks, strict=True):
        for keys, block in zip(group.tolist(), own.tolist(), strict=True):
            columns = [x for key in keys for x in (key, rng.normal(size=(6, 6)) + 3.0 * np.eye(6))]
            b = rng.normal(size=6)
            for linear in (whole, parts[block]):
                linear.add(*columns, b, UNIT)

    def make(block):
        linear = gtsam.GaussianFactorGraph()
        linear.push_back(parts[block])
        return linear

    return whole, Blocks([np.flatnonzero(last == n) for n in range(len(parts))], make)


@given(st.integers(0, 2**31), st.integers(3, 25), st.sampled_from([0.0, 1e-2, 1e2]))
def test_steps_and_covariances_are_those_of_all_at_once(seed, n, damping):
    rng = np.random.default_rng(seed)
    whole, blocks = in_blocks(rng, *tangle(rng, n))
    keys = list(range(n + 3))
    at_once = Blocks([np.array(keys)], lambda _: whole)
    ours, theirs = blocks.step(damping), at_once.step(damping)
    np.testing.assert_allclose(ours.vector(keys), theirs.vector(keys), rtol=1e-8, atol=1e-10)
    assert blocks.error(ours) == pytest.approx(whole.error(ours), rel=1e-12)
    asked = rng.permutation(keys)[: rng.integers(1, len(keys) + 1)].tolist()
    ours, theirs = covariances(blocks, asked), covariances(at_once, asked)
    assert ours.keys() == theirs.keys() == set(asked)
    for key in asked:
        np.testing.assert_allclose(ours[key], theirs[key], rtol=0.0, atol=1e-9 * np.abs(theirs[key]).max())


def test_what_cannot_be_solved_is_told_in_any_block():
    rng = np.random.default_rng(0)
    factors, first = [(0, 1), (1, 2), (2, 3)], np.arange(4)
    _, blocks = in_blocks(rng, [*factors, (1,)], first)
    assert blocks.step(0.0) is not None
    loose = [gtsam.GaussianFactorGraph() for _ in range(2)]
    loose[0].add(0, np.zeros((6, 6)), np.zeros(6), UNIT)
    loose[1].add(1, np.eye(6), np.zeros(6), UNIT)
    blocks = Blocks([np.array([0]), np.array([1])], lambda n: loose[n].clone())
    assert blocks.step(0.0) is None


@pytest.fixture(scope="module")
def run():
    """Four things, 80 keyframes in two visits, localisation that drifts and an error that each visit shares."""
    return make_task(Config(), 400, drifting=True).graph()


@pytest.mark.parametrize("block", [7, 25])
def test_a_run_is_solved_alike(run, block):
    whole, cut_up = run.problem(1000), run.problem(block)
    keys = list(run.initial.keys())
    theirs, ours = (optimise(p, run.initial, max_iterations=30, tolerance=1e-9) for p in (whole, cut_up))
    assert (ours.end, len(ours.trace)) == (theirs.end, len(theirs.trace))
    np.testing.assert_allclose(ours.trace, theirs.trace, rtol=1e-9)
    apart = theirs.values.localCoordinates(ours.values)
    assert np.abs(apart.vector(keys)).max() < 1e-9
    ours, theirs = (covariances(p.blocks(theirs.values), keys) for p in (cut_up, whole))
    for key in keys:
        np.testing.assert_allclose(ours[key], theirs[key], rtol=0.0, atol=1e-8 * np.abs(theirs[key]).max())


def test_no_block_is_more_than_its_keyframes(run):
    whole = run.problem(1000).blocks(run.initial)
    blocks = run.problem(8).blocks(run.initial)
    assert len(whole.own) == 1
    assert len(blocks.own) == 10
    sizes = [blocks.make(n).size() for n in range(10)]
    assert sum(sizes) == whole.last.size() == len(run.labels)
    assert max(sizes) < 0.11 * sum(sizes)
    keys = np.concatenate(blocks.own)
    np.testing.assert_array_equal(np.sort(keys), np.sort(list(run.initial.keys())))
    # what is handed on is a camera, and each thing's last pose and its error in the visit
    assert max(len(m.keys()) for m in blocks.messages()[1:]) <= 1 + 4 + 4


def test_a_variable_is_eliminated_with_its_last_factor(run):
    blocks = run.problem(8).blocks(run.initial)
    for n, own in enumerate(blocks.own):
        k = keyframes_of(own)
        # the last camera and the last poses of a block are the next one's neighbours
        assert ((k < 0) | (k // 8 == n) | (k == 8 * n - 1)).all()
        later = {key for m in range(n + 1, len(blocks.own)) for key in blocks.make(m).keyVector()}
        assert not later & set(own.tolist())
