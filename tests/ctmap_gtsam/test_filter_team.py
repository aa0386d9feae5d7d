"""When processes are started beside this one, what they are given, and what is told of their time."""

import operator
from contextlib import contextmanager
from types import SimpleNamespace

import numba
import pytest

from ctmap_gtsam.filtering import team
from ctmap_gtsam.filtering.tasks import Done
from ctmap_gtsam.filtering.team import LEAST_OBJECTS, LEAST_WORK, Team
from ctmap_gtsam.runtime.threads import cores

PLENTY = 10 * LEAST_WORK


class FakeCrew:
    """Notes what it is given, and does it at once."""

    def __init__(self, size, imports, work, known):
        self.size, self.work, self.given, self.closed = size, work, [], False
        FakeCrew.last = self

    def do(self, shared, jobs, here):
        self.given.append(list(jobs))
        return [self.work(shared, job) for job in jobs]

    def close(self):
        self.closed = True


class Listener:
    """A stage that adds up."""

    def __init__(self):
        self.spent_s = {}

    def spent(self, part, seconds):
        self.spent_s[part] = self.spent_s.get(part, 0.0) + seconds


class FakeHand:
    """Says that every task took four seconds."""

    model = SimpleNamespace(shapes=())

    def __call__(self, scene, task):
        return Done((scene, task), 1, {"objects": 3.0, "reports": 1.0})


@contextmanager
def team_of(monkeypatch, there, possible=True):
    FakeCrew.last = None
    monkeypatch.setattr(team.crew, "Crew", FakeCrew)
    monkeypatch.setattr(team.crew, "possible", lambda: possible)
    monkeypatch.setattr(team, "cores", lambda: there)
    with Team(FakeHand()) as ours:
        yield ours


@pytest.mark.parametrize(
    ("objects", "keyframes", "there", "possible", "size"),
    [
        (LEAST_OBJECTS, PLENTY, 2, True, 2),
        (10, PLENTY, 8, True, 8),
        (10, PLENTY, 1, True, None),
        (10, PLENTY, 2, False, None),
        (LEAST_OBJECTS - 1, PLENTY, 2, True, None),
        (LEAST_OBJECTS, 5, 2, True, None),
    ],
)
def test_processes_are_started_where_they_pay_one_a_core(monkeypatch, objects, keyframes, there, possible, size):
    with team_of(monkeypatch, there, possible) as ours:
        ours.grow(objects, keyframes)
        started = FakeCrew.last
        assert (None if started is None else started.size) == size
        ours.grow(objects, keyframes)
        assert FakeCrew.last is started
    assert started is None or started.closed


def test_the_dearest_are_begun_first_and_what_is_worth_nothing_is_not_sent(monkeypatch):
    with team_of(monkeypatch, 2) as ours:
        ours.grow(10, PLENTY)
        done = ours.do("abcd", [1.0, 0.0, 3.0, 3.0], "scene", Listener())
        assert FakeCrew.last.given == [["c", "d", "a"]]
        assert [one.answer for one in done] == [("scene", task) for task in "abcd"]
        ours.do("ab", [1.0, 0.0], "scene", Listener())  # nobody to share it with
        assert len(FakeCrew.last.given) == 1


@pytest.mark.parametrize("there", [1, 2])
def test_seconds_are_those_of_the_clock_by_what_was_spent(monkeypatch, there):
    listener = Listener()
    with team_of(monkeypatch, there) as ours:
        ours.grow(10, PLENTY)
        ours.do(range(5), [1.0] * 5, "scene", listener)
    assert sum(listener.spent_s.values()) < 1.0
    assert operator.truediv(*listener.spent_s.values()) == pytest.approx(3.0)


def test_one_setting_says_how_many_threads_and_how_many_processes():
    before = numba.get_num_threads()
    try:
        for n in (1, before):
            numba.set_num_threads(n)
            assert cores() == n
    finally:
        numba.set_num_threads(before)
