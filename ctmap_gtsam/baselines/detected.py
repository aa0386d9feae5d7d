"""ICP and FPFH with the detector's boxes: each keyframe by itself, nothing learnt from the last.

Boxes become tracks as for the estimators (`frontend.association`), each an object. In a keyframe that has its box the
object is of the box's best class, at the pose where that class registers to the depth in the box; where there is none,
or nothing fits, what was said last holds. It exists from the keyframe on at which its track had been consistent.
"""

from __future__ import annotations

import numpy as np

from ctmap_gtsam.baselines.placing import Placement, estimate_of, seen_as
from ctmap_gtsam.baselines.registration import Kind, Registrar
from ctmap_gtsam.config import Config
from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.frontend.association import Associator
from ctmap_gtsam.frontend.keyframes import select_keyframes
from ctmap_gtsam.frontend.observation import Observation, observations
from ctmap_gtsam.shapes import build_shapes
from sequences.catalogue import Catalogue
from sequences.progress import SILENT, Progress
from sequences.types import Detection, Run


def register_detections(run: Run, config: Config, progress: Progress = SILENT, *, kind: Kind) -> Estimate:
    """Place each detected thing in each keyframe by itself.

    Args:
        run: from `sequences.bop.load_run`.
        config: settings.
        progress: who is told how far it is.
        kind: how: "icp" or "fpfh". Open3D is needed, see `registration.obstacle`.

    Returns:
        The estimate, of the method that is named as its kind.
    """
    keyframes = select_keyframes(run, config.keyframes)
    registrar = Registrar(kind, run.catalogue, config)
    associator = Associator(config.frontend, run.catalogue)
    said: dict[int, list[Placement | None]] = {}
    with progress.stage(kind, total=len(keyframes)) as stage:
        for observation in observations(run, keyframes, config.seed):
            associator.step(observation)
            for track in associator.tracks():
                before = said.setdefault(track.track_id, [None] * observation.keyframe)
                detection = track.at(observation.keyframe)
                found = None
                if detection is not None:
                    found = _place(registrar, run.catalogue, observation, detection, track.track_id)
                before.append(found or (before[-1] if before else None))
            stage.advance()
    shapes = build_shapes(run.catalogue, config.frontend.mesh_faces)
    return estimate_of(run, config, kind, keyframes, said, shapes)


def _place(
    registrar: Registrar, catalogue: Catalogue, observation: Observation, detection: Detection, object_id: int
) -> Placement | None:
    probability = seen_as(detection.class_scores[None])
    obj_id = catalogue.obj_ids[int(np.argmax(probability))]
    found = registrar.register(obj_id, observation.frame, observation.depth, np.array(detection.box), object_id)
    if found is None:
        return None
    return Placement(probability, observation.frame.T_world_camera @ found.T_camera_object, found.covariance)
