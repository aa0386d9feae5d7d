"""BOP's results of 6D localisation, one CSV line an object and image (bop.felk.cvut.cz/challenges)."""

from __future__ import annotations

from collections.abc import Iterable

from ctmap_gtsam.evaluation.views import FrameView

HEADER = "scene_id,im_id,obj_id,score,R,t,time"


def bop_csv(views: Iterable[FrameView], seconds_per_image: float | None = None) -> str:
    """The whole file as text.

    Args:
        views: from `ctmap_gtsam.evaluation.views.views`.
        seconds_per_image: written as `time`, the same for all images; -1 where nobody knows.

    Returns:
        Lines `scene_id,im_id,obj_id,score,R,t,time`: R row-major, nine numbers apart by blanks; t in millimetres.
    """
    time = -1.0 if seconds_per_image is None else seconds_per_image
    lines = [HEADER]
    for view in views:
        for obj_id, score, T in zip(view.class_id, view.score, view.T_camera_object, strict=True):
            R = " ".join(f"{value:.9g}" for value in T[:3, :3].ravel())
            t = " ".join(f"{value:.6f}" for value in 1e3 * T[:3, 3])
            lines.append(f"{view.frame.scene_id},{view.frame.im_id},{obj_id},{score:.6g},{R},{t},{time:.6g}")
    return "\n".join(lines) + "\n"
