"""Processes that stay and do one job after another for this one, each with one thread.

They are forked from a process that has imported what they need, so that they hold one copy of it and this one goes on
meanwhile. Unlike `multiprocessing`'s they know nothing of the program that started them: a script without a guard may
have some. All jobs have the same answer wherever they are done; a job that fails fails here, with its own exception.
"""

from __future__ import annotations

import faulthandler
import io
import json
import os
import pickle
import queue
import signal
import socket
import subprocess
import sys
import threading
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from multiprocessing.connection import Connection, wait
from typing import Any

from ctmap_gtsam.runtime.threads import ONE_THREAD
from sequences.errors import InputError

Work = Callable[[Any, Any], Any]
"""(what all jobs of a time share, job) -> its answer"""

_NURSERY = "import json, sys; sys.path[:] = json.loads(sys.argv[1]); from {module} import nurse; nurse()"
_AHEAD = 2  # jobs that a worker is given at once, so that it needn't wait for the next one
_BUFFER = 1 << 21  # bytes on their way to a worker; a job should fit
_KILLED_BY = 128  # and the signal, as shells have it
_PATIENCE_S = 5.0  # for the end of a process whose workers have ended


def possible() -> bool:
    """Whether this system has what a crew needs."""
    return sys.platform == "linux"


@dataclass
class _Worker:
    connection: Connection
    jobs: int = 0
    """that it has and hasn't answered"""
    there: bool = False
    """has said so"""
    warm: bool = False
    """has answered once, so it has loaded what is loaded once"""
    taught: bool = False
    """has got what does the jobs"""
    shared: bytes | None = None
    """the last that it was told"""


@dataclass(frozen=True)
class _Raised:
    """What became of a job that failed."""

    error: BaseException


class Crew:
    """Workers that are started at once, wherever this process goes on, and are used as soon as they are there.

    Args:
        size: how many.
        imports: modules that they need.
        work: what does a job, pickled when the first job is given.
        known: parts of `work` that what jobs share refers to, and that aren't sent with it.
    """

    def __init__(self, size: int, imports: Sequence[str], work: Work, known: Sequence[Any] = ()) -> None:
        self._work = work
        self._known = known
        ends = [socket.socketpair() for _ in range(size)]
        theirs = [there.fileno() for _, there in ends]
        arguments = [json.dumps(sys.path), json.dumps(list(imports)), json.dumps(theirs)]
        self._nursery = subprocess.Popen(
            [sys.executable, "-c", _NURSERY.format(module=__name__), *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            env={**os.environ, **dict.fromkeys(ONE_THREAD, "1")},
            pass_fds=theirs,
            process_group=0,  # Ctrl-C is for this process, which ends them
        )
        self._workers = []
        for here, there in ends:
            there.close()
            here.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
            self._workers.append(_Worker(Connection(here.detach())))

    def do(self, shared: Any, jobs: Sequence[Any], here: Callable[[Any], Any] | None = None) -> list[Any]:
        """Answers to all jobs, in their order.

        Args:
            shared: what they share; mustn't change meanwhile.
            jobs: the dearest first.
            here: does a job in this process, for as long as not all workers are ready for more; where not given,
                this process waits for them.

        Raises:
            InputError: a worker was killed. What a job raises is raised as it is.
        """
        answers: dict[int, Any] = {}
        left, told = deque(enumerate(jobs)), b""
        while len(answers) < len(jobs):
            for ahead in range(_AHEAD):
                for worker in self._workers:
                    # the last jobs go to whoever is free first
                    if left and self._takes(worker, ahead) and (ahead == 0 or len(left) > len(self._workers)):
                        told = told or self._dumped(shared)
                        self._give(worker, told, *left.popleft())
            if left and here is not None and not all(worker.warm for worker in self._workers):
                number, job = left.pop()
                answers[number] = here(job)
                self._collect(answers, 0.0)
            elif len(answers) < len(jobs):
                self._collect(answers, None)
        return [answers[number] for number in range(len(jobs))]

    def close(self) -> None:
        """End all workers, whatever they do."""
        for worker in self._workers:
            worker.connection.close()
        self._workers = []
        with suppress(ProcessLookupError):
            os.killpg(self._nursery.pid, signal.SIGKILL)
        self._nursery.wait()

    @staticmethod
    def _takes(worker: _Worker, ahead: int) -> bool:
        """Whether a worker may have another job; only one, while it loads what is loaded once."""
        return worker.there and worker.jobs <= (ahead if worker.warm else 0)

    def _give(self, worker: _Worker, shared: bytes, number: int, job: Any) -> None:
        """Send a job, and before it what the worker hasn't been told yet."""
        try:
            if not worker.taught:
                worker.connection.send_bytes(pickle.dumps((self._work, self._known), pickle.HIGHEST_PROTOCOL))
                worker.taught = True
            if worker.shared is not shared:
                worker.connection.send_bytes(shared)
                worker.shared = shared
            worker.connection.send_bytes(pickle.dumps((number, job), pickle.HIGHEST_PROTOCOL))
        except OSError as error:
            raise self._lost() from error
        worker.jobs += 1

    def _collect(self, answers: dict[int, Any], patience_s: float | None) -> None:
        """Take what workers have sent, after having waited for something for so long at most."""
        by_connection = {worker.connection: worker for worker in self._workers}
        for connection in wait(list(by_connection), patience_s):
            worker = by_connection[connection]  # type: ignore[index]
            try:
                number, answer = pickle.loads(worker.connection.recv_bytes())
            except (EOFError, OSError) as error:
                raise self._lost() from error
            if number is None:
                worker.there = True
                continue
            worker.jobs, worker.warm = worker.jobs - 1, True
            if isinstance(answer, _Raised):
                raise answer.error
            answers[number] = answer

    def _dumped(self, shared: Any) -> bytes:
        file = io.BytesIO()
        _Pickler(file, self._known).dump((None, shared))
        return file.getvalue()

    def _lost(self) -> InputError:
        """What to say where a worker has gone; its end is the nursery's."""
        try:
            code = self._nursery.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            code = 0
        number = -code if code < 0 else code - _KILLED_BY
        known = {s.value for s in signal.Signals}
        how = f"by {signal.Signals(number).name}" if number in known else f"with code {code}"
        return InputError(
            f"a worker process was ended {how}",
            field="NUMBA_NUM_THREADS",
            remedy="set this environment variable to 1: no workers are started then, and less memory is needed",
        )


class _Pickler(pickle.Pickler):
    """Refers to what both sides have by its number."""

    def __init__(self, file: io.BytesIO, known: Sequence[Any]) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self._numbers = {id(part): number for number, part in enumerate(known)}

    def persistent_id(self, part: Any) -> int | None:
        """Its number; None for what is to be sent."""
        return self._numbers.get(id(part))


class _Unpickler(pickle.Unpickler):
    def __init__(self, data: bytes, known: Sequence[Any]) -> None:
        super().__init__(io.BytesIO(data))
        self._known = known

    def persistent_load(self, number: Any) -> Any:
        """What has the number here."""
        return self._known[number]


def nurse() -> None:
    """In a process of its own: import what is needed, fork a worker for each socket, end as the first that fails."""
    imports, sockets = (json.loads(argument) for argument in sys.argv[2:])
    faulthandler.enable()
    for name in imports:
        import_module(name)
    for own in sockets:
        if os.fork() == 0:
            for other in sockets:
                if other != own:
                    os.close(other)  # or who waits for its end would wait for ours
            _serve(Connection(own))
    for own in sockets:
        os.close(own)
    with suppress(ChildProcessError):
        while True:
            code = os.waitstatus_to_exitcode(os.wait()[1])
            if code:
                os._exit(code if code > 0 else _KILLED_BY - code)


def _serve(connection: Connection) -> None:
    """A worker's life. It ends with who it works for."""
    inbox: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(connection, inbox), daemon=True).start()
    with suppress(OSError):
        connection.send_bytes(pickle.dumps((None, None)))
        work, known = pickle.loads(inbox.get())
        shared = None
        while True:
            number, given = _Unpickler(inbox.get(), known).load()
            if number is None:
                shared = given
            else:
                connection.send_bytes(_answered(number, work, shared, given))
    os._exit(0)


def _listen(connection: Connection, inbox: queue.SimpleQueue[bytes]) -> None:
    """Take all that is sent at once: who sends waits for nobody who works."""
    with suppress(EOFError, OSError):
        while True:
            inbox.put(connection.recv_bytes())
    os._exit(0)


def _answered(number: int, work: Work, shared: Any, job: Any) -> bytes:
    try:
        return pickle.dumps((number, work(shared, job)), pickle.HIGHEST_PROTOCOL)
    except Exception as error:
        told = "".join(traceback.format_exception(error))
        error.add_note(f"In a worker process:\n{told}")
        try:
            answer = pickle.dumps((number, _Raised(error)))
            pickle.loads(answer)
        except Exception:  # its class can't be sent
            answer = pickle.dumps((number, _Raised(RuntimeError(told))))
        return answer
