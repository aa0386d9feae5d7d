"""The runs of a measurement, each measured once: what a folder holds of one that was stopped isn't measured again."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from ctmap_gtsam.bench.scaling.loop import write_loop
from ctmap_gtsam.bench.scaling.measuring import Measured, measure, with_particles
from ctmap_gtsam.config import Config
from ctmap_gtsam.runtime.settings import to_dict
from ctmap_gtsam.runtime.sources import code
from sequences.atomic import write_json
from sequences.progress import Progress


@dataclass(frozen=True)
class Parts:
    """Where runs and what they took are kept: what was taken with other settings or code counts as missing."""

    folder: Path
    config: Config
    round_frames: int
    progress: Progress

    def measured(self, method: str, objects: int, keyframes: int, particles: int | None = None) -> Measured:
        """What an estimator takes on a run: the filter's comes before the smoother's.

        Args:
            method: "filter" or "smooth".
            objects: how many things.
            keyframes: of the run.
            particles: an object; None = as in the settings.
        """
        config = self.config if particles is None else with_particles(self.config, particles)
        name = (
            f"{method}-{objects}-objects-{keyframes}-keyframes{'' if particles is None else f'-{particles}-particles'}"
        )
        of = {"config": to_dict(config), "round_frames": self.round_frames, "code": code().estimating}
        path = self.folder / f"{name}.json"
        kept = json.loads(path.read_text()) if path.is_file() else {}
        if kept.get("of") != json.loads(json.dumps(of)):
            with self.progress.stage(name):
                kept = {"of": of, "took": asdict(measure(method, self._loop(objects), keyframes, config))}
            write_json(path, kept)
        return Measured(**{**kept["took"], "each_s": tuple(kept["took"]["each_s"])})

    def _loop(self, objects: int) -> Path:
        path = self.folder / f"{objects}-objects-{self.round_frames}-frames-seed-{self.config.seed}"
        if not path.is_dir():
            write_loop(path, objects, self.config.seed, self.round_frames, self.progress)
        return path


@contextmanager
def parts(keep: Path | None, config: Config, round_frames: int, progress: Progress) -> Iterator[Parts]:
    """In a folder; None = one that is gone afterwards."""
    with TemporaryDirectory(prefix="ctmap-bench-") as temporary:
        yield Parts(Path(temporary) if keep is None else keep, config, round_frames, progress)
