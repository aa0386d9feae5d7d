"""The paper's highlight figure on simulated cases (synthetic): where a map corrects the detector, and by what.

Three stories (Zeng et al., IROS 2018, the figure of detection improvements): a bowl that the detector takes for a
loofah, a shampoo bottle that it takes for milk, and a table under a cloth that it misses. What the detector says of
these things is set; the estimators run with the settings given and see a run like any other. A story that doesn't come
out is drawn as it is.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ctmap_gtsam.bench.highlight.answers import Answer, Case, Word
from ctmap_gtsam.bench.highlight.stories import STORIES, Staging, Story, stage
from ctmap_gtsam.config import Config
from ctmap_gtsam.evaluation.record import DETECTOR
from ctmap_gtsam.methods import METHODS
from sequences.bop import load_run
from sequences.progress import SILENT, Progress
from sequences.truth import load_truth
from sequences.types import Frame, Run

T_MAP, CT_MAP = "filter-t", "filter-ct"
Figures = dict[str, float | str | None]


@dataclass(frozen=True)
class Played:
    """A story and what came of it."""

    staging: Staging
    case: Case
    answers: dict[str, Answer]
    """by method, the detector first"""

    @property
    def story(self) -> Story:
        """Which it is."""
        return self.staging.story

    @property
    def run(self) -> Run:
        """The estimators' run."""
        return self.case.run

    @property
    def frame(self) -> Frame:
        """The image that is shown."""
        return self.run.frames[self.case.frame]


def run(config: Config, progress: Progress = SILENT, out: Path | None = None) -> Figures:
    """Play the stories.

    Args:
        config: settings of simulator and estimators; what the stories need of places goes before them.
        progress: is told of each story.
        out: folder for highlight.png; it isn't drawn where not given.

    Returns:
        For each story `<story>.true_class`, the seed of its place, the image shown, in how many images the thing shows
        and in how many of these the detector has it right; and of each method at the end of the visit
        `<story>.<method>.class`, `.probability`, `.probability_of_truth`, `.iou`, `.position_mm`, `.rotation_deg` and
        `.mssd_mm` of that thing (`answers.Word`); what a method doesn't say is None.

    Raises:
        InputError: no place has what a story needs.
    """
    with tempfile.TemporaryDirectory() as folder, progress.stage("highlight", total=len(STORIES)) as bar:
        played = []
        for story in STORIES:
            played.append(play(story, config, Path(folder) / story.name, progress))
            bar.advance()
        if out is not None:
            from ctmap_gtsam.bench.highlight.plots import write_figure

            write_figure(out / "highlight.png", played)
    return {name: value for one in played for name, value in figures(one).items()}


def play(story: Story, config: Config, folder: Path, progress: Progress = SILENT) -> Played:
    """Stage a story in a folder, run the methods on it and hold them to its truth."""
    staging = stage(story, config.simulation, config.seed)
    staging.write(folder)
    run = load_run(folder)
    estimates = {}
    for name in (T_MAP, CT_MAP):
        runner = METHODS[name].run
        assert runner is not None  # these two are estimators
        estimates[name] = runner(run, config, progress)
    truth = load_truth(run)
    assert truth is not None  # it is simulated
    case = Case(run, truth, staging.inst_id, story.called)
    answers = {name: case.estimate(name, estimate) for name, estimate in estimates.items()}
    return Played(staging, case, {DETECTOR: case.detector(), **answers})


def figures(one: Played) -> Figures:
    """What `run` returns, of one story."""
    shows, right = one.case.frames
    out: Figures = {
        "true_class": one.case.true_name,
        "place_seed": one.staging.seed,
        "image": one.frame.im_id,
        "images_with_it": shows,
        "detector_right_in": right,
    }
    for method, answer in one.answers.items():
        out |= {f"{method}.{name}": value for name, value in _said(answer.word).items()}
    return {f"{one.story.name}.{name}": value for name, value in out.items()}


def _said(word: Word) -> Figures:
    return {
        "class": word.name,
        "probability": word.probability,
        "probability_of_truth": word.probability_of_truth,
        "iou": word.iou,
        "position_mm": None if word.position_m is None else 1e3 * word.position_m,
        "rotation_deg": None if word.rotation_rad is None else float(np.rad2deg(word.rotation_rad)),
        "mssd_mm": None if word.mssd_m is None else 1e3 * word.mssd_m,
    }
