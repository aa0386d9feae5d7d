"""Draws depend on what they are for, and on nothing else."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sequences.seeds import generator

purposes = st.tuples(
    st.integers(0, 2**31),
    st.sampled_from(["filter.birth", "filter.move", "proposer", "sensor"]),
    st.integers(0, 50),
    st.integers(0, 500),
)


@given(purposes, st.lists(purposes, max_size=4))
def test_draws_do_not_depend_on_other_draws(purpose, others):
    alone = generator(*purpose).random(8)
    for other in others:
        generator(*other).normal(size=3)
    np.testing.assert_array_equal(generator(*purpose).random(8), alone)


@given(purposes, purposes)
def test_each_purpose_has_draws_of_its_own(one, other):
    same = np.array_equal(generator(*one).random(8), generator(*other).random(8))
    assert same == (one == other)


def test_neighbouring_purposes_are_uncorrelated():
    draws = np.stack([generator(0, "stage", k, 0).random(4000) for k in range(10)])
    off_diagonal = np.corrcoef(draws)[~np.eye(10, dtype=bool)]
    assert np.abs(off_diagonal).max() < 5 / np.sqrt(4000)


def test_draws_are_the_same_in_every_process():
    code = "from sequences.seeds import generator; print(generator(3, 'filter.birth', 4, 5).integers(0, 2**62))"
    root = Path(__file__).parents[2]
    expected = int(generator(3, "filter.birth", 4, 5).integers(0, 2**62))
    for hash_seed in ("1", "2"):
        environment = {**os.environ, "PYTHONHASHSEED": hash_seed}
        out = subprocess.run(
            [sys.executable, "-c", code], cwd=root, env=environment, capture_output=True, text=True, check=True
        )
        assert int(out.stdout) == expected
