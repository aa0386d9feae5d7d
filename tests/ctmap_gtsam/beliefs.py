"""Beliefs of the filter made by hand."""

from typing import Any

import numpy as np

from ctmap_gtsam.filtering.belief import Belief, ClassBelief


def belief_of(classes: tuple[ClassBelief | None, ...], **known: Any) -> Belief:
    """One that began in this keyframe, of which nothing is known but its classes' particles and what is said."""
    nothing = np.zeros(len(classes))
    blank: dict[str, Any] = {
        "object_id": 0,
        "score_sum": nothing,
        "score_evidence": nothing,
        "log_clutter": 0.0,
        "witness": 0.0,
        "witness_before": 0.0,
        "log_elsewhere": -np.inf,
        "visit": 0,
        "first_ns": 0,
        "present_ns": 0,
        "time_ns": 0,
        "viewpoint": np.ones(3),
        "visible": True,
        "steps": 1,
        "glimpse": None,
    }
    return Belief(classes=classes, **(blank | known))
