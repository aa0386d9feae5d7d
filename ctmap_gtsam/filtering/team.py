"""Who does a keyframe's tasks: this process alone, or with processes beside it, on the cores that there are.

More than half of a task is Python, so threads would wait for each other; processes don't. Beliefs stay here, where
objects are begun, joined and let go between keyframes: each is sent with its task, some 0.1 MB, and comes back.
What is estimated doesn't depend on how many there are.
"""

from __future__ import annotations

import copyreg
import io
import os
import pickle
import signal
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from types import TracebackType
from typing import Any

import numba
from loky import Future, ProcessPoolExecutor
from loky.process_executor import TerminatedWorkerError

from ctmap_gtsam.filtering.tasks import Answer_co, Done, Hand, Scene, Task
from ctmap_gtsam.runtime.threads import ONE_THREAD, cores
from ctmap_gtsam.shapes import Shape
from sequences.errors import InputError
from sequences.progress import Stage

LEAST_OBJECTS = 3
"""fewer don't keep two cores busy"""

LEAST_WORK = 500
"""objects times keyframes to come, from which on it pays to start processes, which takes some seconds of a core"""

_BEGINNING = 20  # keyframes that the searches which an object begins with are worth
_ORPHAN_S = 1.0  # how soon a worker sees that it has none to work for


class Team:
    """Does tasks. A context manager, at whose end no process is left."""

    def __init__(self, hand: Hand) -> None:
        self._hand = hand
        self._beside: _Beside | None = None

    def __enter__(self) -> Team:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._beside is not None:
            self._beside.close()
            self._beside = None

    def grow(self, objects: int, keyframes: int) -> None:
        """Start processes where there are none yet and it pays; nobody waits for them to be there.

        Args:
            objects: that there are, or seem to be.
            keyframes: still to come.
        """
        if self._beside is None and objects >= LEAST_OBJECTS and objects * (keyframes + _BEGINNING) >= LEAST_WORK:
            workers = cores() - 1
            if workers > 0:
                self._beside = _Beside(self._hand, workers)

    def do(
        self, tasks: Sequence[Task[Answer_co]], worth: Sequence[float], scene: Scene, stage: Stage
    ) -> list[Done[Answer_co]]:
        """Tasks done.

        Args:
            tasks: of one keyframe.
            worth: how dear each is; the dearest are begun first, so that nobody waits for one in the end, and what is
                worth nothing isn't sent.
            scene: what they share.
            stage: is told what parts take how long by the clock, whoever did them.
        """
        began = time.perf_counter()

        def here(task: Task[Answer_co]) -> Done[Answer_co]:
            return self._hand(scene, task)

        dearest = sorted((k for k in range(len(tasks)) if worth[k] > 0.0), key=lambda k: (-worth[k], k))
        done = {}
        if self._beside is not None and len(dearest) > 1:
            answers = self._beside.do([tasks[k] for k in dearest], scene, here)
            done = dict(zip(dearest, answers, strict=True))
        every = [done[k] if k in done else here(task) for k, task in enumerate(tasks)]
        _tell(stage, every, time.perf_counter() - began)
        return every


def _tell(stage: Stage, answers: Sequence[Done[Any]], seconds: float) -> None:
    """Tell a stage of seconds by the clock, by the parts that workers spent their own on."""
    spent: dict[str, float] = {}
    for done in answers:
        for part, own in done.seconds.items():
            spent[part] = spent.get(part, 0.0) + own
    total = sum(spent.values())
    for part, own in spent.items():
        stage.spent(part, seconds * own / total)


class _Beside:
    """Processes beside this one, each with a hand of its own and one thread, started while this one goes on."""

    def __init__(self, hand: Hand, workers: int) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="ctmap-")
        file = Path(self._folder.name) / "hand"
        file.write_bytes(pickle.dumps(hand, pickle.HIGHEST_PROTOCOL))
        self._executor = ProcessPoolExecutor(
            workers,
            initializer=_begin,
            initargs=(file, os.getpid()),
            env=dict.fromkeys(ONE_THREAD, "1"),
        )
        self._there: Future = self._executor.submit(os.getpid)
        self._workers = workers
        self._scenes = 0

    def do(
        self, tasks: Sequence[Task[Answer_co]], scene: Scene, here: Callable[[Task[Answer_co]], Done[Answer_co]]
    ) -> list[Done[Answer_co]]:
        """Tasks done, the dearest of which come first: workers begin with those and this process with the others.

        Raises:
            InputError: a worker was killed. What a task raises is raised as it is.
        """
        done: dict[int, Done[Answer_co]] = {}
        given: dict[int, Future] = {}
        left = deque(range(len(tasks)))
        file = self._told(scene)
        try:
            with _one_thread():
                while left:
                    while left and sum(not one.done() for one in given.values()) < self._room(len(left)):
                        k = left.popleft()
                        given[k] = self._executor.submit(_do, file, tasks[k])
                    if left:
                        k = left.pop()
                        done[k] = here(tasks[k])
            done |= {k: one.result() for k, one in given.items()}
        except TerminatedWorkerError as error:
            raise _lost(error) from error
        file.unlink()
        return [done[k] for k in range(len(tasks))]

    def _room(self, left: int) -> int:
        """How many tasks workers may have: none before one is there, then one more than they do, the last not ahead."""
        if not self._there.done():
            return 0
        return self._workers + (left > self._workers)

    def close(self) -> None:
        """End all workers, whatever they do."""
        self._executor.shutdown(kill_workers=True)
        self._folder.cleanup()

    def _told(self, scene: Scene) -> Path:
        """A file with what tasks share, which refers to shapes by their number."""
        self._scenes += 1
        data = io.BytesIO()
        pickler = pickle.Pickler(data, pickle.HIGHEST_PROTOCOL)
        pickler.dispatch_table = {**copyreg.dispatch_table, Shape: _referred}
        pickler.dump(scene)
        file = Path(self._folder.name) / f"scene{self._scenes}"
        file.write_bytes(data.getbuffer())
        return file


@contextmanager
def _one_thread() -> Iterator[None]:
    """Kernels of this process have one thread meanwhile: the other cores are the workers'."""
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        yield
    finally:
        numba.set_num_threads(before)


def _lost(error: TerminatedWorkerError) -> InputError:
    """What to say where a worker has gone."""
    return InputError(
        f"a worker process was ended: {' '.join(str(error).split())}",
        field="NUMBA_NUM_THREADS",
        remedy="set this environment variable to 1: no workers are started then, and less memory is needed",
    )


def _referred(shape: Shape) -> tuple[Callable[[int], Shape], tuple[int]]:
    return _shape, (shape.index,)


# in a worker


_hand: Hand


def _begin(file: Path, parent: int) -> None:
    """Get what does tasks; end with the process that they are done for."""
    global _hand  # noqa: PLW0603
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # it is for the parent, which ends its workers
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    _hand = pickle.loads(file.read_bytes())


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_ORPHAN_S)
    os._exit(1)


def _shape(index: int) -> Shape:
    return _hand.model.shapes[index]


@lru_cache(maxsize=1)
def _scene(file: Path) -> Scene:
    """What tasks share, read once."""
    scene: Scene = pickle.loads(file.read_bytes())
    return scene


def _do(file: Path, task: Task[Answer_co]) -> Done[Answer_co]:
    return _hand(_scene(file), task)
