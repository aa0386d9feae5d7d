"""A filter's last word copied back: what hindsight without smoothing buys.

The filter's map at the last keyframe of a visit has seen all of the visit. Copied into all of its keyframes it is what
the paper evaluates ("we take the estimated 6 DOF pose of all objects in the scene at the end of each RGB-D sequence and
project them back"), and what a smoother has to beat. It knows nothing of what moved during the visit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.baselines.placing import in_view
from ctmap_gtsam.config import Config
from ctmap_gtsam.estimate import Estimate, Ledger, Modes
from ctmap_gtsam.shapes import Shape, build_shapes
from sequences.progress import Progress
from sequences.types import Run

Ints = NDArray[np.int64]
NAME = "last-copied-back"


def copy_back(run: Run, config: Config, progress: Progress, estimate: Estimate) -> Estimate:
    """The estimate with each visit's keyframes showing the objects of its last one; cameras and moves are left.

    The ledger keeps its lines of the last keyframes, of which alone they are true.
    """
    with progress.stage(NAME, total=1) as stage:
        last = _last_keyframes(estimate.keyframe_visit)
        kept = last[estimate.ledger.keyframe] == estimate.ledger.keyframe
        copied = replace(
            estimate,
            class_probability=estimate.class_probability[:, last],
            existence=estimate.existence[:, last],
            modes=_copied(estimate.modes, last),
            ledger=Ledger(**{name: values[kept] for name, values in vars(estimate.ledger).items()}),
            meta={**estimate.meta, "method": NAME},
        )
        shapes = build_shapes(run.catalogue, config.frontend.mesh_faces)
        copied = replace(copied, in_view=_in_view(run, copied, shapes))
        stage.advance()
    return copied


def _last_keyframes(visits: Ints) -> Ints:
    """(K,) the last keyframe of each keyframe's visit."""
    return np.searchsorted(visits, visits, side="right") - 1


def _copied(modes: Modes, last: Ints) -> Modes:
    """For each keyframe the rows of its visit's last one, in the order of objects, keyframes and rows."""
    rows = [np.flatnonzero(modes.keyframe == k) for k in last]
    row = np.concatenate([np.zeros(0, dtype=np.int64), *rows])
    keyframe = np.repeat(np.arange(len(last)), [len(r) for r in rows])
    order = np.lexsort((row, keyframe, modes.object[row]))
    copied = {name: values[row[order]] for name, values in vars(modes).items()}
    return Modes(**{**copied, "keyframe": keyframe[order]})


def _in_view(run: Run, estimate: Estimate, shapes: Sequence[Shape]) -> NDArray[np.bool_]:
    """(N, K) for poses that stay while the camera moves; as its recorded poses have it."""
    out = np.zeros(estimate.existence.shape, dtype=np.bool_)
    for n, k in np.argwhere(estimate.best_mode >= 0):
        shape = shapes[run.catalogue.index(int(estimate.best_class[n, k]))]
        out[n, k] = in_view(shape, estimate.pose[n, k], run.frames[int(estimate.keyframe_frame[k])])
    return out
