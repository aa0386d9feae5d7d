"""The settings of sensor and detector, from runs with truth: how sure a measurement may be.

Fitted on all frames, and again on fewer: every n-th, and the first half of each visit. A model in which each fact is
counted once says the same at any length of run; where two fits' intervals are apart it doesn't, and that is said.
Intervals are from a bootstrap over object-visits (Efron, Annals of Statistics 1979): what one object gets wrong in a
visit it gets wrong throughout. `learning.depth` and `learning.detections` say what is fitted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.config import Config
from ctmap_gtsam.learning.depth import DepthFit, DepthStatistics, View, views_of
from ctmap_gtsam.learning.detections import DetectorFit, DetectorStatistics, Sight, sights_of
from ctmap_gtsam.learning.sources import truth_of
from sequences.bop import load_run
from sequences.errors import InputError
from sequences.progress import SILENT, Progress
from sequences.seeds import generator

Array = NDArray[np.float64]

LEVEL = 0.95
"""of the intervals"""
DRAWS = 200
"""of the bootstrap"""
LEAST_VISITS = 5
"""object-visits without which there is nothing to draw from"""
ALL = "all frames"


@dataclass(frozen=True)
class Fitted:
    """One setting."""

    section: str
    name: str
    value: float
    interval: tuple[float, float]
    visits: int
    """object-visits that it comes from"""

    def agrees(self, other: Fitted) -> bool:
        """Whether two fits' intervals overlap."""
        return self.interval[0] <= other.interval[1] and other.interval[0] <= self.interval[1]


@dataclass(frozen=True)
class Calibration:
    """The same settings fitted to runs of several lengths, ALL first."""

    lengths: Mapping[str, tuple[Fitted, ...]]

    @property
    def fitted(self) -> tuple[Fitted, ...]:
        """From all frames."""
        return self.lengths[ALL]

    def beside(self, one: Fitted) -> dict[str, Fitted]:
        """A setting as the other lengths have it."""
        others = {name: fits for name, fits in self.lengths.items() if name != ALL}
        return {n: f for n, fits in others.items() for f in fits if (f.section, f.name) == (one.section, one.name)}

    def disagreeing(self) -> list[tuple[Fitted, str, Fitted]]:
        """A setting, a length, and how it is there, where that is beyond both intervals."""
        return [(one, n, f) for one in self.fitted for n, f in self.beside(one).items() if not one.agrees(f)]


def calibrate(runs: Sequence[Path], config: Config, every: int = 3, progress: Progress = SILENT) -> Calibration:
    """Fit the settings to runs on disk.

    Args:
        runs: folders of runs with truth, of any catalogues.
        config: what isn't fitted: outliers, steps of the samples; and where the search starts.
        every: the second length is every so-many-th frame.
        progress: is told of each run, then of each fit.

    Raises:
        InputError: a file is broken, a run has no truth, or there is too little to fit.
    """
    views, sights = _gather(runs, config, progress)
    return fit_lengths(views, sights, config, every, progress, DRAWS)


def fit_lengths(
    views: Sequence[View],
    sights: Sequence[Sight],
    config: Config,
    every: int = 3,
    progress: Progress = SILENT,
    draws: int = 200,
) -> Calibration:
    """Fit to all frames, to every so-many-th, and to the first half of each visit; parameters as of `calibrate`."""
    chosen: dict[str, Callable[[View | Sight], bool]] = {
        ALL: lambda one: True,
        f"1 frame in {every}": lambda one: one.order % every == 0,
        "first halves": lambda one: one.order < one.frames / 2,
    }
    lengths = {}
    with progress.stage("fits", total=len(chosen)) as stage:
        for name, keep in chosen.items():
            kept = [v for v in views if keep(v)], [s for s in sights if keep(s)]
            lengths[name] = (*_fit_depth(kept[0], config, draws), *_fit_detector(kept[1], config, draws))
            stage.advance()
    return Calibration(lengths)


def _gather(runs: Sequence[Path], config: Config, progress: Progress) -> tuple[list[View], list[Sight]]:
    views: list[View] = []
    sights: list[Sight] = []
    with progress.stage("depth at true poses", total=len(runs)) as stage:
        for path in runs:
            run = load_run(path)
            truth = truth_of(path, run)
            views += views_of(run, truth, config, 1 + max((v.visit for v in views), default=-1))
            sights += sights_of(run, truth, config, 1 + max((s.visit for s in sights), default=-1))
            stage.advance()
    if len({v.visit for v in views}) < LEAST_VISITS:
        raise InputError(
            f"movable things show well in fewer than {LEAST_VISITS} object-visits",
            file=runs[0],
            field="visits",
            remedy="give more runs, or runs that come nearer to things",
        )
    return views, sights


def _fit_depth(views: Sequence[View], config: Config, draws: int) -> list[Fitted]:
    if not views:
        return []
    statistics = DepthStatistics(views, config.sensor)
    n = len(statistics.images)
    return _with_intervals("sensor", n, draws, statistics.fit, generator(config.seed, "learning.depth"))


def _fit_detector(sights: Sequence[Sight], config: Config, draws: int) -> list[Fitted]:
    """Nothing where nothing was detected."""
    if not any(s.scores is not None for s in sights):
        return []
    statistics = DetectorStatistics(sights, config)
    n = statistics.visits
    confusion, interval = statistics.confusion_posterior(LEVEL)
    others = _with_intervals("detector", n, draws, statistics.fit, generator(config.seed, "learning.detector"))
    return [Fitted("detector", "confusion", confusion, interval, statistics.believed), *others]


def _with_intervals(
    section: str, visits: int, draws: int, fit: Callable[[Array], DepthFit | DetectorFit], rng: np.random.Generator
) -> list[Fitted]:
    """The fit to all object-visits, each setting with its interval over draws of them."""
    best = asdict(fit(np.ones(visits)))
    weights = rng.multinomial(visits, np.full(visits, 1.0 / visits), draws).astype(np.float64)
    drawn = [asdict(fit(weight)) for weight in weights]
    tails = (0.5 - LEVEL / 2, 0.5 + LEVEL / 2)
    ends = {name: np.quantile([draw[name] for draw in drawn], tails) for name in best}
    return [Fitted(section, name, best[name], (float(ends[name][0]), float(ends[name][1])), visits) for name in best]


def described(calibration: Calibration) -> str:
    """TOML for `--config`: what was fitted to all frames, and beside it how well it is known."""
    lines = [f"# written by `ctmap train calibration`; the intervals hold {LEVEL:.0%}".replace("%", " %")]
    for section in dict.fromkeys(one.section for one in calibration.fitted):
        lines += ["", f"[{section}]"]
        for one in (f for f in calibration.fitted if f.section == section):
            others = (f"; {name} {_known(other)}" for name, other in calibration.beside(one).items())
            lines += [f"# {_known(one)}, {one.visits} object-visits{''.join(others)}", f"{one.name} = {one.value:.4g}"]
    return "\n".join(lines) + "\n"


def _known(one: Fitted) -> str:
    return f"{one.value:.3g} ({one.interval[0]:.3g} to {one.interval[1]:.3g})"
