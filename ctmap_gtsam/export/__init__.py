"""Estimates in other people's formats."""

from ctmap_gtsam.export.bop import bop_csv
from ctmap_gtsam.export.coco import coco_detections, coco_results

__all__ = ["bop_csv", "coco_detections", "coco_results"]
