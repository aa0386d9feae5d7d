"""Estimates held to the truth, and to each other."""

from ctmap_gtsam.evaluation.ceiling import truth_estimate
from ctmap_gtsam.evaluation.comparison import Comparison, compare
from ctmap_gtsam.evaluation.record import Record, pooled, pose_curve, record

__all__ = ["Comparison", "Record", "compare", "pooled", "pose_curve", "record", "truth_estimate"]
