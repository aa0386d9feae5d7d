"""Jobs done by a few processes, one process a job: what kills a job kills nothing else.

The processes are forked from a server that has imported what they need, so that a job begins at once and all jobs have
the same code, whatever is edited meanwhile. Each has one thread: what it gives doesn't depend on how many there are.
"""

from __future__ import annotations

import faulthandler
import multiprocessing
import os
import signal
import sys
import threading
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, Protocol

from ctmap_gtsam.runtime.threads import ONE_THREAD


class Job(Protocol):
    """Something to be done in a process of its own, to which it is pickled."""

    def __call__(self) -> None:
        """Do it; an exception is a failure."""

    @property
    def log(self) -> Path:
        """A file for what goes wrong; it isn't there where nothing did."""


class Work(Protocol):
    """Who knows what is to be done."""

    def next(self) -> Job | None:
        """A job that may begin now; None where there is none before another ends."""

    def ended(self, job: Job, failed: bool) -> None:
        """Be told that a job ended."""


def work_off(work: Work, workers: int, imports: Sequence[str] = ()) -> None:
    """Do all jobs; those that run are ended where this one is.

    Args:
        work: gives the jobs.
        workers: how many processes; with 0 the jobs are done here, one after another.
        imports: modules that the jobs need.
    """
    if workers == 0:
        while (job := work.next()) is not None:
            work.ended(job, failed=not _succeeds(job))
        return
    context = _context(imports)
    running: dict[Any, Job] = {}
    try:
        while True:
            while len(running) < workers and (job := work.next()) is not None:
                process = context.Process(target=_alone, args=(job,))
                with _one_thread():
                    process.start()
                running[process] = job
            if not running:
                return
            ended = wait([process.sentinel for process in running])
            for process in [p for p in running if p.sentinel in ended]:
                process.join()
                work.ended(running.pop(process), failed=process.exitcode != 0)
    finally:
        for process in running:
            process.kill()
            process.join()


def _context(imports: Sequence[str]) -> Any:
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(imports))
    return context


@contextmanager
def _one_thread() -> Iterator[None]:
    """What is started meanwhile has one thread in every library."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _alone(job: Job) -> None:
    """In the job's own process, which doesn't outlive the one that started it."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # it is for the parent, which ends its jobs
    job.log.parent.mkdir(parents=True, exist_ok=True)
    with job.log.open("w") as log:
        os.dup2(log.fileno(), 2)  # libraries write there, too
    faulthandler.enable()
    if not _succeeds(job):
        sys.exit(1)


def _end_with(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)


def _succeeds(job: Job) -> bool:
    """Do a job; where it fails, its log ends with the traceback."""
    try:
        job()
    except Exception:
        job.log.parent.mkdir(parents=True, exist_ok=True)
        with job.log.open("a") as log:
            traceback.print_exc(file=log)
        return False
    job.log.unlink(missing_ok=True)
    return True
