"""Views of an object that are kept, so that a pose found late is held to what was seen before.

The pose of a thing that stays is a parameter, and particles that never held the right one can't come to it by weights:
their class has lost the evidence of all views that it would have explained. What a search finds later is therefore
scored on the views that were kept, as in the resample-move filter (Gilks and Berzuini, J. R. Statist. Soc. B 2001).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.frontend.proposer import Proposer, View
from ctmap_gtsam.shapes import Shape

Array = NDArray[np.float64]

_KEPT = 10  # views of an object at most
_NEWS = 0.5  # least share of a view that is kept: what is less new is counted with the next


@dataclass(frozen=True)
class Memory:
    """What an object looked like since it was last moved."""

    views: tuple[tuple[View, Array], ...] = ()
    """views, each with the share of all that it stands for, and T_camera_world (4, 4)"""
    pending: float = 0.0
    """share of views that none stands for yet"""

    def joined(self, view: View, T_camera_world: Array) -> Memory:
        """With one view more."""
        share = self.pending + view.share
        if share < _NEWS:
            return replace(self, pending=share)
        return Memory(_thinned((*self.views, (replace(view.coarse(), share=share), T_camera_world))))

    def log_likelihood(self, proposer: Proposer, shape: Shape, T_world_centre: Array, reach: Array) -> float:
        """What all views say for one pose (4, 4), nats. 0 where there are none.

        Args:
            proposer: scores.
            shape: the class.
            T_world_centre: the pose.
            reach: (2,) rad and metres that a view may have the pose elsewhere: localisation errs from view to view.
        """
        return float(sum(proposer.near(shape, view, T @ T_world_centre, reach) for view, T in self.views))


def _thinned(views: tuple[tuple[View, Array], ...]) -> tuple[tuple[View, Array], ...]:
    """At most `_KEPT` views: the one that counts least goes, and the one before it stands for it."""
    if len(views) <= _KEPT:
        return views
    least = 1 + int(np.argmin([view.share for view, _ in views[1:]]))
    before, T = views[least - 1]
    joined = replace(before, share=before.share + views[least][0].share)
    return (*views[: least - 1], (joined, T), *views[least + 1 :])
