"""When processes are started beside this one, what they are given and what is told of their time; how they end."""

import operator
import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numba
import pytest

from ctmap_gtsam.filtering import team
from ctmap_gtsam.filtering.tasks import Done
from ctmap_gtsam.filtering.team import LEAST_OBJECTS, LEAST_WORK, Team
from ctmap_gtsam.runtime.threads import cores
from sequences.errors import InputError

TREE = Path(__file__).parents[2]

PLENTY = 10 * LEAST_WORK


class FakeBeside:
    """Notes what it is given, and does it at once."""

    def __init__(self, hand, workers):
        self.hand, self.workers, self.given, self.closed = hand, workers, [], False
        FakeBeside.last = self

    def do(self, tasks, scene, here):
        self.given.append(list(tasks))
        return [self.hand(scene, task) for task in tasks]

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
def team_of(monkeypatch, there):
    FakeBeside.last = None
    monkeypatch.setattr(team, "_Beside", FakeBeside)
    monkeypatch.setattr(team, "cores", lambda: there)
    with Team(FakeHand()) as ours:
        yield ours


@pytest.mark.parametrize(
    ("objects", "keyframes", "there", "workers"),
    [
        (LEAST_OBJECTS, PLENTY, 2, 1),
        (10, PLENTY, 8, 7),
        (10, PLENTY, 1, None),
        (LEAST_OBJECTS - 1, PLENTY, 2, None),
        (LEAST_OBJECTS, 5, 2, None),
    ],
)
def test_processes_are_started_where_they_pay_one_a_core_with_this(monkeypatch, objects, keyframes, there, workers):
    with team_of(monkeypatch, there) as ours:
        ours.grow(objects, keyframes)
        started = FakeBeside.last
        assert (None if started is None else started.workers) == workers
        ours.grow(objects, keyframes)
        assert FakeBeside.last is started
    assert started is None or started.closed


def test_the_dearest_are_begun_first_and_what_is_worth_nothing_is_not_sent(monkeypatch):
    with team_of(monkeypatch, 2) as ours:
        ours.grow(10, PLENTY)
        done = ours.do("abcd", [1.0, 0.0, 3.0, 3.0], "scene", Listener())
        assert FakeBeside.last.given == [["c", "d", "a"]]
        assert [one.answer for one in done] == [("scene", task) for task in "abcd"]
        ours.do("ab", [1.0, 0.0], "scene", Listener())  # nobody to share it with
        assert len(FakeBeside.last.given) == 1


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


class RealHand:
    """Its tasks are the names of what it can, with what they are given."""

    def __call__(self, scene, task):
        kind, *given = task
        return Done(getattr(self, kind)(scene, *given), 1, {})

    def times(self, scene, factor):
        return scene * factor

    def who(self, scene):
        return os.getpid(), {os.environ.get(name) for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS")}

    def refuse(self, scene):
        raise InputError("is torn", file="image.png", field="depth", remedy="look for another")

    def die(self, scene):
        os.kill(os.getpid(), signal.SIGKILL)

    def sleep(self, scene):
        time.sleep(60.0)


@contextmanager
def beside(workers):
    """Processes that are there and do all."""
    ours = team._Beside(RealHand(), workers)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(team._Beside, "_room", lambda ours, left: PLENTY)
        try:
            ours._there.result()
            yield ours
        finally:
            ours.close()


def refused(task):
    raise AssertionError("nothing is to be done here")


def alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def gone(pid, within_s=60.0):
    until = time.monotonic() + within_s
    while alive(pid) and time.monotonic() < until:
        time.sleep(0.02)
    return not alive(pid)


def test_processes_answer_as_this_one_would_fail_as_it_would_and_end_with_it():
    with beside(1) as ours:
        for scene in (3, 5):
            answers = [done.answer for done in ours.do([("times", k) for k in range(9)], scene, refused)]
            assert answers == [scene * k for k in range(9)]
        (done,) = ours.do([("who",)], None, refused)
        pid, threads = done.answer
        assert pid != os.getpid()
        assert threads == {"1"}
        with pytest.raises(InputError) as caught:
            ours.do([("refuse",)], None, refused)
    error = caught.value
    assert (error.message, error.file, error.field) == ("is torn", Path("image.png"), "depth")
    assert error.remedy == "look for another"
    assert gone(pid)


def test_until_a_process_is_there_all_is_done_here():
    hand = RealHand()
    ours = team._Beside(hand, 1)
    try:
        done = ours.do([("who",)] * 2, None, lambda task: hand(None, task))
    finally:
        ours.close()
    assert {one.answer[0] for one in done} == {os.getpid()}


def test_a_process_that_is_killed_is_an_error_and_nobody_waits():
    with beside(2) as ours, pytest.raises(InputError, match="SIGKILL") as caught:
        ours.do([("die",), ("sleep",)], None, refused)
    assert caught.value.field == "NUMBA_NUM_THREADS"


SCRIPT = """
import signal
from tests.ctmap_gtsam.test_filter_team import beside, refused
signal.signal(signal.SIGINT, signal.default_int_handler)  # who runs the tests in the background has it ignored
with beside(1) as ours:
    print(ours.do([("who",)], None, refused)[0].answer[0], flush=True)
    ours.do([("sleep",)], None, refused)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("ended_by", [signal.SIGINT, signal.SIGKILL])
def test_processes_end_with_who_started_them(ended_by, tmp_path):
    """A script without a guard, interrupted or killed while it waits for them."""
    file = tmp_path / "script.py"
    file.write_text(SCRIPT)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(TREE), os.environ.get("PYTHONPATH", "")])}
    script = subprocess.Popen(
        [sys.executable, file], env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    pid = int(script.stdout.readline())
    assert alive(pid)
    script.send_signal(ended_by)
    script.communicate(timeout=60.0)
    assert gone(pid)
