"""A table under a cloth: what is there isn't quite what the catalogue knows, and a detector misses it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sequences.catalogue import Mesh
from sequences.simulation.shapes.shape import Shape
from sequences.simulation.solids import join, loft, moved

Array = NDArray[np.float64]

THICK_M = 0.0015
OVERHANG_M = 0.2
CORNER_M = 0.008  # radius of the cloth's bend round the top's corners
OFF_M = 0.006  # from the top's edge
LINING_M = 0.004  # between the skins of the hanging part, whose quads are cut along different diagonals
COLOURS = (((226, 220, 206), (150, 58, 52)), ((188, 206, 214), (244, 244, 240)), ((178, 60, 58), (240, 232, 216)))
"""ground and lines"""


def clothed(shape: Shape, rng: np.random.Generator) -> Shape:
    """A piece of furniture with one level top, under a cloth that hangs down all round.

    The class and its mesh stay as they are; `Shape.appearance` is the furniture with the cloth on it, and the support
    area lies on the cloth.

    Args:
        shape: what to cover.
        rng: draws colour and folds.
    """
    (area,) = shape.areas
    mesh = shape.object_class.mesh
    height = float(area.centre[2] - mesh.vertices[:, 2].min())
    ground, line = COLOURS[int(rng.integers(len(COLOURS)))]
    sections, lined = _sections(area.size / 2.0, min(OVERHANG_M, height - 0.1), rng.uniform(0.0, 2.0 * np.pi, 3))
    colours = np.where(np.append(np.repeat(lined, sections.shape[1]), [False, False])[:, None], line, ground)
    cloth = join([(moved(loft(sections), area.centre), colours)])
    covered = Mesh(
        np.concatenate([mesh.vertices, cloth.vertices]),
        np.concatenate([mesh.faces, cloth.faces + np.int32(len(mesh.vertices))]),
        np.concatenate([mesh.colours, cloth.colours]),
    )
    lifted = replace(area, centre=area.centre + np.array([0.0, 0.0, THICK_M]))
    return replace(shape, appearance=covered, areas=(lifted,))


def _sections(half: Array, hang: float, phases: Array) -> tuple[Array, list[bool]]:
    """Cross-sections (m, n, 3) of the cloth, and whether each belongs to a coloured line.

    The skin starts in the middle above, runs to the hem and back underneath. Frame: the middle of the furniture's top.

    Args:
        half: (2,) of the top's size, metres.
        hang: how far the cloth hangs down, metres.
        phases: (3,) of its folds.
    """
    above = [(_level(half, inset, THICK_M), line) for inset, line in [*_line(0.1, 0.085), (0.01, False), (0.0, False)]]
    drops = [(0.04, False), (0.25, False), (0.5, False), *_line(0.78, 0.88), (1.0, False)]
    outside = [(_skirt(half, drop, hang, phases, OFF_M), line) for drop, line in drops]
    inside = [(_skirt(half, drop, hang, phases, OFF_M - LINING_M), False) for drop, _ in drops[::-1]]
    below = [(_level(half, inset, -1e-4), False) for inset in (0.0, 0.1)]
    rings = [*above, *outside, *inside, *below]
    return np.stack([points for points, _ in rings]), [line for _, line in rings]


def _line(start: float, stop: float) -> list[tuple[float, bool]]:
    """A coloured line between two places, its edges sharp."""
    e = 1e-3 * np.sign(stop - start)
    return [(start - e, False), (start, True), (stop, True), (stop + e, False)]


def _level(half: Array, inset: float, z: float) -> Array:
    """(n, 3) the top's outline, drawn in, at a height."""
    points, _, _ = _outline(half - inset)
    return np.column_stack([points, np.full(len(points), z)])


def _skirt(half: Array, drop: float, hang: float, phases: Array, off: float) -> Array:
    """(n, 3) where the hanging part is at a share of its length: folds widen downwards, corners hang lower."""
    points, outwards, along = _outline(half)
    corner = 4.0 * np.abs(outwards[:, 0] * outwards[:, 1]) ** 2
    waves = np.sin(23.0 * along + phases[0]) + 0.6 * np.sin(37.0 * along + phases[1]) + 2.0 * corner
    out = off + drop * (0.025 + 0.009 * waves + 0.02 * corner)
    z = -drop * hang * (1.0 + 0.25 * corner + 0.02 * np.sin(9.0 * along + phases[2]))
    return np.column_stack([points + out[:, None] * outwards, z])


def _outline(half: Array) -> tuple[Array, Array, Array]:
    """A rectangle's rounded outline, counter-clockwise: points (n, 2), outward normals (n, 2), arc length (n,)."""
    points, outwards = [], []
    for k, (i, j) in enumerate([(1, 1), (-1, 1), (-1, -1), (1, -1)]):
        angle = np.pi / 2.0 * (k + np.linspace(0.0, 1.0, 9))
        normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        centre = (half - CORNER_M) * (i, j)
        side = (half - CORNER_M) * ((-1, 1), (-1, -1), (1, -1), (1, 1))[k]  # the next corner
        run = np.linspace(0.0, 1.0, 46)[1:-1, None]
        bend = centre + CORNER_M * normal
        points += [bend, bend[-1] + run * (side - centre)]
        outwards += [normal, np.broadcast_to(normal[-1], (len(run), 2))]
    line = np.concatenate(points)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=-1))])
    return line, np.concatenate(outwards), along
