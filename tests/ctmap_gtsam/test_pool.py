"""Jobs in processes of their own: what one does to itself it does to no other, and none outlives who started it."""

import json
import multiprocessing
import os
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from ctmap_gtsam.runtime.pool import work_off


@dataclass(frozen=True)
class Write:
    """Writes its environment, after a while."""

    folder: Path
    name: str
    seconds: float = 0.0

    def __call__(self) -> None:
        (self.folder / f"{self.name}.begun").write_text("")
        time.sleep(self.seconds)
        threads = {name: os.environ.get(name) for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS")}
        (self.folder / f"{self.name}.json").write_text(json.dumps(threads))

    @property
    def log(self) -> Path:
        return self.folder / "logs" / f"{self.name}.log"


@dataclass(frozen=True)
class Raise(Write):
    def __call__(self) -> None:
        raise ValueError(f"no {self.name}")


@dataclass(frozen=True)
class Abort(Write):
    def __call__(self) -> None:
        os.abort()


@dataclass(frozen=True)
class Here(Write):
    """Done by who is asked for it: nothing is started."""


class Listed:
    """Jobs one after another."""

    def __init__(self, jobs):
        self.jobs = list(jobs)
        self.failed = {}

    def next(self):
        job = self.jobs.pop(0) if self.jobs else None
        if isinstance(job, Here):
            job()
            return self.next()
        return job

    def ended(self, job, failed):
        self.failed[job.name] = failed


@pytest.mark.parametrize("workers", [0, 1, 2])
def test_a_job_that_fails_is_told_and_the_others_are_done(workers, tmp_path):
    kinds = [Write, Raise, Write] if workers == 0 else [Write, Raise, Abort, Write]
    work = Listed(kind(tmp_path, str(k)) for k, kind in enumerate(kinds))
    work_off(work, workers)
    assert work.failed == {str(k): kind is not Write for k, kind in enumerate(kinds)}
    logs = {path.stem for path in (tmp_path / "logs").iterdir()}
    assert logs == {name for name, failed in work.failed.items() if failed}
    assert "ValueError: no 1" in (tmp_path / "logs" / "1.log").read_text()
    if workers:
        assert "abort" in (tmp_path / "logs" / "2.log").read_text().lower()


def test_jobs_have_one_thread_each_and_the_parent_keeps_its_own(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_NUM_THREADS", "7")
    parent = run_apart(Listed([Write(tmp_path, "job"), Here(tmp_path, "parent")]))
    parent.join()
    threads = [json.loads((tmp_path / f"{name}.json").read_text()) for name in ("job", "parent")]
    assert threads[0] == {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    assert threads[1]["NUMBA_NUM_THREADS"] == "7"


def test_jobs_end_with_who_started_them(tmp_path):
    """Even where that is killed without a chance to tell them."""
    parent = run_apart(Listed([Write(tmp_path, "job", seconds=2.0)]))
    while not (tmp_path / "job.begun").exists():
        time.sleep(0.02)
    parent.kill()
    parent.join()
    time.sleep(2.5)
    assert not (tmp_path / "job.json").exists()


def run_apart(work):
    """Work off in a process without a server of its own yet."""
    process = multiprocessing.get_context("spawn").Process(target=work_off, args=(work, 1))
    process.start()
    return process
