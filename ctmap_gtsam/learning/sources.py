"""The runs that are learned from: each with its truth, or with an estimate of it in the truth's place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.estimate import Estimate
from sequences import layout, se3
from sequences.bop import load_run, load_truth
from sequences.catalogue import Catalogue, ObjectClass
from sequences.errors import InputError
from sequences.types import Run, Truth

Array = NDArray[np.float64]

_SAME_POSE = (0.1, 0.02)  # rad, metres: the truth of what was not touched differs by less


@dataclass(frozen=True)
class Source:
    """A run and what is known of it."""

    run: Run
    known: Truth | Estimate


def load_sources(runs: Sequence[Path], estimates: Sequence[Path] = ()) -> tuple[Catalogue, tuple[Source, ...]]:
    """All runs, and all classes of theirs.

    Args:
        runs: folders; an obj_id is the same class in all of them.
        estimates: files of `Estimate.save`, each used in place of the truth of the run that it is of.

    Raises:
        InputError: a file is broken; a run has neither truth nor estimate, or calls a class something else than another
            run does; an estimate is of none of the runs.
    """
    of_run = {str(e.meta["fingerprint"]): (path, e) for path in estimates for e in (Estimate.load(path),)}
    loaded = [load_run(path) for path in runs]
    classes: dict[int, ObjectClass] = {}
    sources: list[Source] = []
    for path, run in zip(runs, loaded, strict=True):
        _join(classes, run.catalogue, path)
        given = of_run.pop(run.fingerprint, None)
        sources.append(Source(run, truth_of(path, run) if given is None else given[1]))
    if of_run:
        file = next(iter(of_run.values()))[0]
        raise InputError("it is of none of the runs", file=file, field="meta.fingerprint", remedy="name its run, too")
    return Catalogue(tuple(c for _, c in sorted(classes.items()))), tuple(sources)


def truth_of(path: Path, run: Run) -> Truth:
    """The truth of a run in a folder; InputError where it has none."""
    truth = load_truth(run)
    if truth is None:
        remedy = "give a run with truth; persistence and context take an --estimate of it instead"
        raise InputError("the run has no truth", file=path, field=layout.SCENE_GT, remedy=remedy)
    return truth


def _join(classes: dict[int, ObjectClass], own: Catalogue, path: Path) -> None:
    """Add a run's classes to those of the others."""
    for c in own.classes:
        known = classes.setdefault(c.obj_id, c)
        if (known.name, known.category) != (c.name, c.category):
            raise InputError(
                f"it is {c.name} of category {c.category}, in another run {known.name} of {known.category}",
                file=path / layout.CATALOGUE,
                field=str(c.obj_id),
                remedy="learn from runs whose obj_ids are the same classes",
            )


def same_place(T_before: Array, T_after: Array) -> bool:
    """Whether a thing of true poses (4, 4) at two times was not touched in between."""
    xi = se3.local(T_before, T_after)
    return bool(np.linalg.norm(xi[:3]) <= _SAME_POSE[0] and np.linalg.norm(xi[3:]) <= _SAME_POSE[1])
