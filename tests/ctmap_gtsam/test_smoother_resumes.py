"""Smoothing that was stopped between two rounds goes on from the last one, and ends in the same bytes."""

import tracemalloc
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ctmap_gtsam.filtering.filter import filter_run
from ctmap_gtsam.runtime.checkpoint import Checkpoint
from ctmap_gtsam.smoothing.smoother import smooth_run
from sequences.progress import SILENT
from tests.ctmap_gtsam.scenes import CHEAP, config_of, small_run

CONFIG = config_of(*CHEAP, "frontend.angular_step_rad=0.01", "frontend.mesh_faces=200")


class Killed(BaseException):
    """As SIGINT would end it."""


class Listener:
    """Hears which stages there were; kills at one."""

    def __init__(self, last: str | None = None) -> None:
        self.stages: list[str] = []
        self.last = last

    @contextmanager
    def stage(self, name, total=None):
        if name == self.last:
            raise Killed
        self.stages.append(name)
        with SILENT.stage(name, total) as stage:
            yield stage


@pytest.fixture(scope="module")
def begun():
    """A run, and what the filter says of it."""
    run = small_run(frames=4, moved={"mug": (0.02, 0.2)}, visits=2)[0]
    return run, filter_run(run, CONFIG)


def stored(estimate, folder):
    estimate.save(folder / "estimate.npz")
    return (folder / "estimate.npz").read_bytes()


@pytest.fixture(scope="module")
def uninterrupted(begun, tmp_path_factory):
    return stored(smooth_run(*begun, CONFIG), tmp_path_factory.mktemp("whole"))


def killed(begun, keep, at):
    with pytest.raises(Killed):
        smooth_run(*begun, CONFIG, progress=Listener(at), keep=keep)


@pytest.mark.parametrize(("at", "left"), [("round 2", ["round 2", "round 3"]), ("round 3", ["round 3"])])
def test_what_was_killed_between_rounds_ends_in_the_bytes_of_an_uninterrupted_run(
    begun, uninterrupted, tmp_path, at, left
):
    keep, listener = tmp_path / "rounds.npz", Listener()
    killed(begun, keep, at)
    assert keep.exists()
    again = smooth_run(*begun, CONFIG, progress=listener, keep=keep)
    assert listener.stages == ["place", *left]
    assert stored(again, tmp_path) == uninterrupted
    assert not keep.exists()


def test_a_round_of_other_settings_or_cut_short_is_not_gone_on_from(begun, tmp_path):
    keep = tmp_path / "rounds.npz"
    killed(begun, keep, "round 2")
    whole = keep.read_bytes()
    other = replace(CONFIG, seed=1)
    for config, data in ((other, whole), (CONFIG, whole[: len(whole) // 2]), (CONFIG, b"")):
        keep.write_bytes(data)
        listener = Listener("round 1")
        with pytest.raises(Killed):
            smooth_run(*begun, config, progress=listener, keep=keep)
        assert listener.stages == ["place"]


@dataclass(frozen=True)
class Some:
    """A state."""

    value: object


ARRAYS = hnp.arrays(
    st.sampled_from([np.float64, np.float32, np.int64, np.bool_]), hnp.array_shapes(min_dims=0, min_side=0)
)
PLAIN = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text()
TREES = st.recursive(
    PLAIN | ARRAYS | ARRAYS.map(np.asfortranarray),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.lists(inner, max_size=3).map(tuple)
        | st.dictionaries(st.integers() | st.text(), inner, max_size=3)
        | inner.map(Some)
    ),
    max_leaves=8,
)


def same(a, b):
    if isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        assert a.shape == b.shape
        assert a.tobytes() == b.tobytes()
        assert a.flags.f_contiguous == b.flags.f_contiguous
        assert a.flags.c_contiguous == b.flags.c_contiguous
    elif isinstance(a, Some):
        same(a.value, b.value)
    elif isinstance(a, dict):
        assert list(a) == list(b)
        same(list(a.values()), list(b.values()))
    elif isinstance(a, list | tuple):
        assert type(a) is type(b)
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            same(x, y)
    else:
        assert type(a) is type(b)
        assert a == b


@given(TREES)
def test_a_state_comes_back_to_the_last_bit(tmp_path_factory, tree):
    checkpoint = Checkpoint(tmp_path_factory.getbasetemp() / "state.npz", {"of": 1}, (Some,))
    checkpoint.save(Some(tree))
    same(Some(tree), checkpoint.load())
    assert replace(checkpoint, key={"of": 2}).load() is None
    checkpoint.remove()
    assert checkpoint.load() is None


def test_what_it_does_not_know_is_refused(tmp_path):
    with pytest.raises(TypeError, match="Some"):
        Checkpoint(tmp_path / "state.npz", {}, ()).save(Some(1))
    with pytest.raises(TypeError, match="objects"):
        Checkpoint(tmp_path / "state.npz", {}, ()).save(np.array([None]))


def test_what_ends_half_way_leaves_what_was_kept_before(tmp_path):
    checkpoint = Checkpoint(tmp_path / "state.npz", {}, ())
    checkpoint.save([np.arange(3)])
    with pytest.raises(TypeError):
        checkpoint.save([np.arange(5), Some(1)])
    same([np.arange(3)], checkpoint.load())
    assert list(tmp_path.iterdir()) == [tmp_path / "state.npz"]


def test_a_number_that_changed_on_disk_is_noticed(tmp_path):
    checkpoint = Checkpoint(tmp_path / "state.npz", {}, ())
    checkpoint.save([np.full(100, 7.0)])
    data = checkpoint.path.read_bytes()
    at = data.index(np.full(100, 7.0).tobytes())
    checkpoint.path.write_bytes(data[: at + 80] + np.float64(8.0).tobytes() + data[at + 88 :])
    assert checkpoint.load() is None


def test_a_state_is_not_held_twice(tmp_path):
    """Neither the numbers nor the tree, of which a long run has many small pieces."""
    state = [(np.full((6, 6), float(i)), {i: 0.1 * i}) for i in range(20_000)]
    checkpoint = Checkpoint(tmp_path / "state.npz", {}, ())
    tracemalloc.start()
    try:
        checkpoint.save(state)
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert most < 0.1 * sum(array.nbytes for array, _ in state)
    same(state[-1], checkpoint.load()[-1])
