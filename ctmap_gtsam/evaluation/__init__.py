"""Estimates held to the truth, and to each other."""

from ctmap_gtsam.evaluation.comparison import Comparison, compare

__all__ = ["Comparison", "compare"]
