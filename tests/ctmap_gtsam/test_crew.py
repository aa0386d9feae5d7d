"""Processes that stay: they answer as this one would, fail as it would, and none outlives who started it."""

import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

from ctmap_gtsam.runtime.crew import Crew, possible
from sequences.errors import InputError

pytestmark = pytest.mark.skipif(not possible(), reason="no crew on this system")

TREE = Path(__file__).parents[2]


class Known:
    """Something that both sides have."""

    def __reduce_ex__(self, protocol):
        return Known, ()


class Unsendable(Exception):
    def __init__(self, a, b):
        super().__init__(f"{a} and {b}")


class Work:
    def __init__(self, known=()):
        self.known = known

    def __call__(self, shared, job):
        kind, *given = job
        return getattr(self, kind)(shared, *given)

    def times(self, shared, factor):
        return shared * factor

    def who(self, shared):
        time.sleep(0.05)
        return os.getpid()

    def threads(self, shared):
        return {name: os.environ[name] for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS")}

    def is_known(self, shared, number):
        return shared[number] is self.known[number]

    def long(self, shared, n):
        return len(shared), bytes(n)

    def refuse(self, shared):
        raise InputError("is torn", file="image.png", field="depth", remedy="look for another")

    def refuse_oddly(self, shared):
        raise Unsendable("this", "that")

    def die(self, shared):
        os.kill(os.getpid(), signal.SIGKILL)

    def sleep(self, shared):
        time.sleep(60.0)


@contextmanager
def crew_of(size, *given):
    crew = Crew(size, ["ctmap_gtsam.runtime"], *given)
    try:
        yield crew
    finally:
        crew.close()


def alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def gone(pids, within_s=10.0):
    until = time.monotonic() + within_s
    while any(alive(pid) for pid in pids) and time.monotonic() < until:
        time.sleep(0.02)
    return not any(alive(pid) for pid in pids)


def test_answers_come_in_the_order_of_the_jobs_and_what_is_shared_is_the_last():
    with crew_of(2, Work()) as crew:
        for shared in (3, 5):
            assert crew.do(shared, [("times", k) for k in range(20)]) == [shared * k for k in range(20)]
        assert crew.do(None, []) == []


def test_jobs_are_done_by_all_and_each_has_one_thread():
    with crew_of(2, Work()) as crew:
        pids = set(crew.do(None, [("who",)] * 20))
        assert len(pids) == 2
        assert os.getpid() not in pids
        (threads,) = crew.do(None, [("threads",)])
        assert set(threads.values()) == {"1"}


def test_until_workers_are_there_jobs_are_done_here():
    with crew_of(2, Work()) as crew:
        assert crew.do(2, [("times", 3)], here=lambda job: ("here", job)) == [("here", ("times", 3))]


def test_what_both_have_is_not_sent():
    known = (Known(), Known())
    with crew_of(1, Work(known), known) as crew:
        assert crew.do((known[0], Known()), [("is_known", 0), ("is_known", 1)]) == [True, False]


def test_long_jobs_and_answers_wait_for_nobody():
    """More than a pipe holds, both ways at once."""
    with crew_of(2, Work()) as crew:
        answers = crew.do(bytes(5_000_000), [("long", 3_000_000)] * 8)
    assert [(n, len(data)) for n, data in answers] == [(5_000_000, 3_000_000)] * 8


def test_what_a_job_raises_is_raised_here():
    with crew_of(2, Work()) as crew, pytest.raises(InputError) as caught:
        crew.do(None, [("refuse",), ("who",)])
    error = caught.value
    assert (error.message, error.file, error.field) == ("is torn", Path("image.png"), "depth")
    assert error.remedy == "look for another"
    assert "in refuse" in error.__notes__[0]


def test_an_exception_that_cannot_be_sent_is_told():
    with crew_of(1, Work()) as crew, pytest.raises(RuntimeError, match="this and that"):
        crew.do(None, [("refuse_oddly",)])


def test_a_worker_that_is_killed_is_an_error_and_nobody_waits():
    with crew_of(2, Work()) as crew, pytest.raises(InputError, match="SIGKILL") as caught:
        crew.do(None, [("die",), ("sleep",)])
    assert caught.value.field == "NUMBA_NUM_THREADS"


def test_modules_that_are_missing_are_an_error():
    crew = Crew(2, ["ctmap_gtsam.nowhere"], Work())
    with pytest.raises(InputError, match="code 1"):
        crew.do(None, [("who",)])
    crew.close()


def test_with_the_crew_all_its_processes_end():
    with crew_of(2, Work()) as crew:
        pids = set(crew.do(None, [("who",)] * 20))
    assert len(pids) == 2
    assert gone(pids)


SCRIPT = """
from ctmap_gtsam.runtime.crew import Crew
from tests.ctmap_gtsam.test_crew import Work
crew = Crew(2, ["ctmap_gtsam.runtime"], Work())
try:
    print(*set(crew.do(None, [("who",)] * 20)), flush=True)
    crew.do(None, [("sleep",)] * 2)
finally:
    crew.close()
"""


@pytest.mark.parametrize("ended_by", [signal.SIGINT, signal.SIGKILL])
def test_workers_end_with_who_started_them(ended_by, tmp_path):
    """A script without a guard, interrupted or killed while it waits for them."""
    file = tmp_path / "script.py"
    file.write_text(SCRIPT)
    environment = {**os.environ, "PYTHONPATH": str(TREE)}
    script = subprocess.Popen(
        [sys.executable, file], env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    pids = [int(pid) for pid in script.stdout.readline().split()]
    assert len(pids) == 2
    assert all(alive(pid) for pid in pids)
    time.sleep(0.3)
    script.send_signal(ended_by)
    script.communicate(timeout=30.0)
    assert gone(pids)
