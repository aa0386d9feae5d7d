"""Where a thing goes that somebody moves: it comes to rest on a level surface, or on something that was not seen.

Filter and smoother weigh a moved object's new pose by one density, in the unit of the density of having stayed: poses
modulo the object's symmetries. It names no other object as the supporter: what a table carries is its top, which is one
of the level surfaces that the images show, whether somebody modelled the table or not.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ctmap_gtsam.model import Model
from ctmap_gtsam.shapes import Shape
from factors.mixture import log_sum
from factors.persistence import facing_log_density
from factors.persistence import landing_log_density as on_one
from sequences.geometry import Plane

Array = NDArray[np.float64]


def landing_log_density(
    model: Model, shape: Shape, T_world_centre: Array, supports: tuple[Plane, ...], covariance: Array | None = None
) -> Array:
    """The log density (K,) of a moved thing's new pose, nats per rad^3 m^3 modulo its symmetries.

    With 1 - `context.other_support` it rests on one of the known surfaces: each as likely, anywhere on it, on any of
    its stable faces, in any yaw. Otherwise, and where no surface is known, it is anywhere in the neighbourhood
    (`Model.log_uniform`).

    Args:
        model: settings.
        shape: of the thing.
        T_world_centre: (K, 4, 4).
        supports: level surfaces, world frame.
        covariance: (K, 6, 6) of the poses' right tangents, over which the density is averaged; None for points. Height
            and tilt are taken as linear, the tilt's error as the same in both directions.
    """
    anywhere = np.full(len(T_world_centre), model.log_uniform(shape))
    if not supports or not len(T_world_centre):
        return anywhere
    on_each = np.stack([_on(model, shape, T_world_centre, plane, len(supports), covariance) for plane in supports])
    unseen = model.config.context.other_support
    with np.errstate(divide="ignore"):
        return np.asarray(np.logaddexp(np.log1p(-unseen) + log_sum(on_each, axis=0), np.log(unseen) + anywhere))


def _on(model: Model, shape: Shape, T: Array, plane: Plane, others: int, covariance: Array | None) -> Array:
    """(K,) of landing on one of so many surfaces."""
    settings = model.config.context
    up = plane.normal @ T[:, :3, :3]
    heights = up @ shape.hull_points.T + (T[:, :3, 3] @ plane.normal - plane.offset)[:, None]
    lowest = np.argmin(heights, axis=-1)
    height = heights[np.arange(len(T)), lowest]
    height_variance = np.full(len(T), settings.support_tolerance_m**2 + settings.support_sigma_m**2)
    tilt_variance = np.full(len(T), model.config.prediction.landing_tilt_rad**2)
    if covariance is not None:
        free = shape.symmetry.free_axes
        known = np.eye(6) - free @ free.T  # a turn that nobody sees tilts nothing
        spread = known @ covariance @ known
        along = np.concatenate([np.cross(shape.hull_points[lowest], up), up], axis=-1)
        height_variance += np.einsum("ki,kij,kj->k", along, spread, along)
        turns = spread[:, :3, :3]
        tilt_variance += 0.5 * (np.einsum("kii->k", turns) - np.einsum("ki,kij,kj->k", up, turns, up))
    facing = facing_log_density(
        up,
        shape.rests[:, 2],
        np.log(shape.rest_weights),
        tilt_sigma_rad=np.sqrt(tilt_variance),
        symmetry=shape.symmetry,
    )
    area = np.where(plane.contains(T[:, :3, 3]), plane.area, np.inf)
    return on_one(others, area, facing, height, height_sigma_m=np.sqrt(height_variance), symmetry=shape.symmetry)
