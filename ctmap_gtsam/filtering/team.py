"""Who does a keyframe's tasks: this process alone, or with processes beside it, on the cores that there are.

More than half of a task is Python, so threads would wait for each other; processes don't. Beliefs stay here, where
objects are begun, joined and let go between keyframes: each is sent with its task, some 0.1 MB, and comes back.
What is estimated doesn't depend on how many there are.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from types import TracebackType
from typing import Any

from ctmap_gtsam.filtering.tasks import Answer_co, Done, Hand, Scene, Task
from ctmap_gtsam.runtime import crew
from ctmap_gtsam.runtime.threads import cores
from sequences.progress import Stage

LEAST_OBJECTS = 3
"""fewer don't keep two cores busy"""

LEAST_WORK = 500
"""objects times keyframes to come, from which on it pays to start processes, which takes some seconds of a core"""

_BEGINNING = 20  # keyframes that the searches which an object begins with are worth


class Team:
    """Does tasks. A context manager, at whose end no process is left."""

    def __init__(self, hand: Hand) -> None:
        self._hand = hand
        self._crew: crew.Crew | None = None

    def __enter__(self) -> Team:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._crew is not None:
            self._crew.close()
            self._crew = None

    def grow(self, objects: int, keyframes: int) -> None:
        """Start processes where there are none yet and it pays; nobody waits for them to be there.

        Args:
            objects: that there are, or seem to be.
            keyframes: still to come.
        """
        if self._crew is None and objects >= LEAST_OBJECTS and objects * (keyframes + _BEGINNING) >= LEAST_WORK:
            size = cores()
            if size > 1 and crew.possible():
                self._crew = crew.Crew(size, [Hand.__module__], self._hand, self._hand.model.shapes)

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
        if self._crew is not None and len(dearest) > 1:
            answers = self._crew.do(scene, [tasks[k] for k in dearest], here)
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
