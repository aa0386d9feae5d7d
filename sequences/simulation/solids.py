"""Closed triangle meshes from a few numbers: turned, rounded, swept, joined and painted.

Every builder gives a watertight solid whose faces are counter-clockwise seen from outside, in metres. Where two colours
shall meet at a sharp line, the builders are told to put a row of vertices there: a painted mesh has two vertices at one
place where the faces about it differ in colour.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sequences.catalogue import Mesh

Array = NDArray[np.float64]
Solid = tuple[Array, NDArray[np.int32]]
"""vertices (V, 3), metres, and faces (F, 3)"""
Paint = Callable[[Array], Array]
"""points (n, 3) -> colours (n, 3), 0 to 255"""
Part = tuple[Solid, Paint | Array]
"""a solid and its paint, or the colours (V, 3) of its vertices"""
Mask = Callable[[Array], NDArray[np.bool_]]
"""vertices (V, 3) -> whether each belongs (V,)"""

INSET_M = 1e-4  # inwards from its corners a face shows its own colour, not that of the faces beside it
ONE_COLOUR = 8.0  # colours that differ by less, of 255, are shades of one


def arc(centre: tuple[float, float], radius: float, start_deg: float, stop_deg: float, n: int = 5) -> list[list[float]]:
    """Points of a circle's arc in the plane: a piece of a profile for `lathe`."""
    angle = np.radians(np.linspace(start_deg, stop_deg, n))
    return (np.asarray(centre) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)).tolist()


def seam(a: ArrayLike, b: ArrayLike, at: float) -> list[list[float]]:
    """The point on the line a-b at the height `at`, for a sharp change of colour in a profile (r, z)."""
    start, run = np.asarray(a, dtype=np.float64), np.subtract(b, a)
    return [(start + (at - start[1]) / run[1] * run).tolist()]


def lathe(profile: Sequence[Sequence[float]], segments: int = 36) -> Solid:
    """Turn a profile about z.

    Args:
        profile: (n, 2) radius and height, metres, both ends on the axis, running so that the solid lies to the left:
            from the bottom's centre outwards and up, and for a hollow thing over the rim and down again inside.
        segments: corners of each circle.
    """
    rings = np.asarray(profile, dtype=np.float64)[1:-1]
    angle = 2.0 * np.pi * np.arange(segments) / segments
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    heights = np.broadcast_to(rings[:, None, 1:], (len(rings), segments, 1))
    walls = np.concatenate([rings[:, None, :1] * circle, heights], axis=-1)
    poles = [[0.0, 0.0, profile[0][1]], [0.0, 0.0, profile[-1][1]]]
    return np.concatenate([walls.reshape(-1, 3), poles]), _tube_faces(len(rings), segments)


def tube(path: ArrayLike, radius: ArrayLike, segments: int = 12, flatten: float = 1.0) -> Solid:
    """A round bar along a path.

    Args:
        path: (n, 3) its middle line.
        radius: (n,) or one number for the whole path.
        segments: corners of each cross-section.
        flatten: its thickness across the plane in which the path bends, as a share of that in the plane. A straight
            path bends in a level plane, or in the plane x = 0 where it runs along z.
    """
    line = np.asarray(path, dtype=np.float64)
    along = np.gradient(line, axis=0)
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    across = np.cross(line[-1] - line[0], line[len(line) // 2] - line[0])
    if np.linalg.norm(across) < 1e-12:
        upwards = np.roll([0.0, 0.0, 1.0], int(abs(along[0, 2]) > 0.9))
        across = upwards - (upwards @ along[0]) * along[0]
    across /= np.linalg.norm(across)
    inward = np.cross(across, along)
    angle = 2.0 * np.pi * np.arange(segments) / segments
    size = np.broadcast_to(np.asarray(radius, dtype=np.float64), len(line))[:, None, None]
    offsets = np.cos(angle)[:, None] * inward[:, None] + flatten * np.sin(angle)[:, None] * across
    walls = line[:, None] + size * offsets
    faces = _tube_faces(len(line), segments)
    return oriented((np.concatenate([walls.reshape(-1, 3), line[:1], line[-1:]]), faces))


def _tube_faces(rings: int, segments: int) -> NDArray[np.int32]:
    """Faces between rings of vertices, and fans to the two poles that follow them."""
    ring, k = np.meshgrid(np.arange(rings - 1), np.arange(segments), indexing="ij")
    a, b = (ring * segments + k).ravel(), (ring * segments + (k + 1) % segments).ravel()
    c, d = a + segments, b + segments
    rim, following = np.arange(segments), (np.arange(segments) + 1) % segments
    top, pole = (rings - 1) * segments, np.full(segments, rings * segments)
    parts = [(a, b, d), (a, d, c), (following, rim, pole), (top + rim, top + following, pole + 1)]
    return np.concatenate([np.stack(part, axis=-1) for part in parts]).astype(np.int32)


def ring(profile: Sequence[Sequence[float]], segments: int = 36) -> Solid:
    """Turn a closed outline about z that stays off the axis: a roll, a ring.

    Args:
        profile: (n, 2) radius and height, metres, running so that the solid lies to the left.
        segments: corners of each circle.
    """
    points = np.asarray(profile, dtype=np.float64)
    n = len(points)
    angle = 2.0 * np.pi * np.arange(segments) / segments
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    heights = np.broadcast_to(points[:, None, 1:], (n, segments, 1))
    vertices = np.concatenate([points[:, None, :1] * circle, heights], axis=-1).reshape(-1, 3)
    row, k = np.meshgrid(np.arange(n), np.arange(segments), indexing="ij")
    following, turned = (row + 1) % n, (k + 1) % segments
    a, b = (row * segments + k).ravel(), (row * segments + turned).ravel()
    c, d = (following * segments + k).ravel(), (following * segments + turned).ravel()
    return vertices, np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)]).astype(np.int32)


def loft(sections: ArrayLike) -> Solid:
    """A skin over cross-sections, closed by a fan from the middle of the first and of the last.

    Args:
        sections: (m, n, 3) outlines of equally many corners, each seen whole from its middle.
    """
    rings = np.asarray(sections, dtype=np.float64)
    m, n = rings.shape[:2]
    poles = rings[[0, -1]].mean(axis=1)
    return oriented((np.concatenate([rings.reshape(-1, 3), poles]), _tube_faces(m, n)))


def stacked(levels: Sequence[Sequence[float]], power: float = 2.0, segments: int = 32) -> Solid:
    """A skin over level cross-sections that are superellipses |x / a|^p + |y / b|^p = 1.

    Args:
        levels: (m, 3) half width a, half depth b and height z, metres; two more numbers shift a section in x and y.
        power: p: 2 is an ellipse, 4 a square with well-rounded corners.
        segments: corners of each section, spread evenly by direction.
    """
    sections = []
    for a, b, z, *shift in levels:
        x, y = [*shift, 0.0, 0.0][:2]
        outline = superellipse(a, b, power, segments)
        sections.append(np.concatenate([outline + np.array([x, y]), np.full((segments, 1), z)], axis=-1))
    return loft(sections)


def superellipse(a: float, b: float, power: float, segments: int = 32) -> Array:
    """(segments, 2) corners of |x / a|^p + |y / b|^p = 1, counter-clockwise."""
    angle = 2.0 * np.pi * (np.arange(segments) + 0.5) / segments
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    reach = (np.abs(direction) ** power).sum(axis=-1, keepdims=True) ** (-1.0 / power)
    return direction * reach * (a, b)


def puff(size: ArrayLike, swell: Callable[[Array], Array], rings: int = 18, segments: int = 36) -> Solid:
    """An ellipsoid whose surface swells and sinks.

    Args:
        size: (3,) its measures without the swell, metres.
        swell: unit directions (n, 3) from the middle -> (n,) factors on the reach that way.
        rings: circles of latitude.
        segments: corners of each.
    """
    tilt = np.pi * (np.arange(rings + 2)[1:-1] / (rings + 1) - 0.5)
    turn = 2.0 * np.pi * np.arange(segments) / segments
    t, u = np.meshgrid(tilt, turn, indexing="ij")
    walls = np.stack([np.cos(t) * np.cos(u), np.cos(t) * np.sin(u), np.sin(t)], axis=-1).reshape(-1, 3)
    directions = np.concatenate([walls, [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]])
    vertices: Array = directions * swell(directions)[:, None] * (np.asarray(size, dtype=np.float64) / 2.0)
    return vertices, _tube_faces(rings, segments)


def block(
    size: ArrayLike,
    at: ArrayLike = (0.0, 0.0, 0.0),
    cuts: tuple[Sequence[float], Sequence[float], Sequence[float]] = ((), (), ()),
) -> Solid:
    """A sharp-edged box about a point, for keys, legs and the like; `cuts` are those of `rounded_box`."""
    half = np.asarray(size, dtype=np.float64) / 2.0
    return moved(_box_grid([np.array([-h, *cut, h]) for h, cut in zip(half, cuts, strict=True)]), at)


def scored(solid: Solid, axis: int | ArrayLike, places: Sequence[float]) -> Solid:
    """The same surface with vertices along planes, where colours may then change sharply.

    Args:
        solid: what to score.
        axis: 0, 1 or 2, or a normal (3,), of the planes.
        places: where the planes meet the axis, metres.
    """
    normal = np.eye(3)[axis] if isinstance(axis, int) else np.asarray(axis, dtype=np.float64)
    for place in places:
        solid = _split(solid, normal, place)
    return solid


def _split(solid: Solid, normal: Array, place: float) -> Solid:
    """Cut the faces that a plane crosses into pieces on either side of it."""
    vertices, faces = solid
    level = vertices @ normal - place
    level[np.abs(level) < 1e-6] = 0.0  # such a vertex counts as on the plane: no slivers
    side = np.sign(level)[faces]
    on, alone = side == 0.0, side * np.roll(side, 1, axis=1) + side * np.roll(side, -1, axis=1) == -2.0
    # the corner that lies alone on its side of the plane, or on the plane itself, comes first
    lone = np.argmax(np.where(on.any(axis=1)[:, None], on, alone), axis=1)
    crossed = (side.min(axis=1) < 0) & (side.max(axis=1) > 0)
    turned = np.take_along_axis(faces, (lone[:, None] + np.arange(3)) % 3, axis=1)
    through = crossed & (level[turned[:, 0]] == 0.0)  # the plane passes through the first corner
    across = crossed & ~through
    a, b, c = turned[across].T
    d, e, f = turned[through].T
    start, end = np.concatenate([a, a, e]), np.concatenate([b, c, f])
    edges, cut = np.unique(np.sort(np.stack([start, end], -1), axis=-1), axis=0, return_inverse=True)
    low, high = level[edges[:, 0]], level[edges[:, 1]]
    share = (low / (low - high))[:, None]
    points = (1.0 - share) * vertices[edges[:, 0]] + share * vertices[edges[:, 1]]
    p, q, r = np.split(len(vertices) + cut.reshape(-1), [len(a), 2 * len(a)])
    pieces = [(a, p, q), (p, b, c), (p, c, q), (d, e, r), (d, r, f)]
    new = np.concatenate([faces[~crossed], *(np.stack(piece, -1) for piece in pieces)])
    return np.concatenate([vertices, points]), new.astype(np.int32)


def rounded_box(
    size: ArrayLike,
    radius: float,
    cuts: tuple[Sequence[float], Sequence[float], Sequence[float]] = ((), (), ()),
    steps: int = 2,
) -> Solid:
    """A box about the origin with rounded edges and corners.

    Args:
        size: (3,) outer measures, metres.
        radius: of edges and corners, less than half the least measure.
        cuts: coordinates along x, y and z at which colours may change sharply.
        steps: faces along each rounded edge's quarter circle, half of them on either side.
    """
    half = np.asarray(size, dtype=np.float64) / 2.0
    lines = [_grid_lines(h, radius, cut, steps) for h, cut in zip(half, cuts, strict=True)]
    vertices, faces = _box_grid(lines)
    core = np.clip(vertices, -(half - radius), half - radius)
    out = vertices - core
    length = np.linalg.norm(out, axis=-1, keepdims=True)
    return core + radius * out / np.maximum(length, 1e-12), faces


def _grid_lines(half: float, radius: float, cuts: Sequence[float], steps: int) -> Array:
    """Coordinates of a box's grid lines along one axis. On the edge they are tangents, so that arcs are cut evenly."""
    edge = half - radius + radius * np.tan(np.linspace(0.0, np.pi / 4.0, steps // 2 + 1))
    seams = [c for c in cuts if abs(c) < half - radius]
    return np.unique(np.round(np.concatenate([edge, -edge, seams]), 9))


def cuts_every(step: float, half: float) -> tuple[float, ...]:
    """Cuts at most `step` apart over -half..half, symmetric about 0."""
    n = max(1, int(np.ceil(2.0 * half / step)))
    return tuple(np.linspace(-half, half, n + 1)[1:-1].tolist())


def _box_grid(lines: Sequence[Array]) -> Solid:
    """The surface of a box whose faces are cut along the given coordinates."""
    vertices, faces, start = [], [], 0
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        p, q = np.meshgrid(lines[first], lines[second], indexing="ij")
        index = np.arange(p.size).reshape(p.shape)
        a, b, c, d = (index[i, j].ravel() for i, j in _CORNERS)
        for side in (0, -1):
            points = np.empty((p.size, 3))
            points[:, first], points[:, second], points[:, axis] = p.ravel(), q.ravel(), lines[axis][side]
            quads = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
            faces.append(start + (quads if side == -1 else quads[:, ::-1]))
            vertices.append(points)
            start += p.size
    stacked = np.concatenate(vertices).round(9)
    unique, inverse = np.unique(stacked, axis=0, return_inverse=True)
    return unique, inverse.reshape(-1)[np.concatenate(faces)].astype(np.int32)


_CORNERS = (
    (slice(None, -1), slice(None, -1)),
    (slice(1, None), slice(None, -1)),
    (slice(1, None), slice(1, None)),
    (slice(None, -1), slice(1, None)),
)


def moved(solid: Solid, offset: ArrayLike, R: Array | None = None) -> Solid:
    """Turn a solid by R (3, 3), then shift it, metres."""
    vertices: Array = solid[0] if R is None else solid[0] @ R.T
    return vertices + np.asarray(offset, dtype=np.float64), solid[1]


def scaled(solid: Solid, factors: ArrayLike) -> Solid:
    """Stretch a solid along the axes."""
    vertices: Array = solid[0] * np.asarray(factors)
    return vertices, solid[1]


def oriented(solid: Solid) -> Solid:
    """The solid with its faces turned outwards, should they look inwards (the sign of its volume says so)."""
    corners = solid[0][solid[1]]
    volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    return solid if volume > 0 else (solid[0], np.ascontiguousarray(solid[1][:, ::-1]))


def rotation(axis: str, degrees: float) -> Array:
    """(3, 3) rotation about x, y or z."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    R = np.eye(3)
    R[i, i], R[j, j], R[i, j], R[j, i] = c, c, -s, s
    return R


def plain(colour: ArrayLike) -> Paint:
    """One colour all over."""
    return lambda vertices: np.broadcast_to(np.asarray(colour, dtype=np.float64), vertices.shape)


def placed(part: Part, offset: ArrayLike, R: Array | None = None) -> Part:
    """A painted solid turned by R (3, 3), then shifted, metres; its print moves with it."""
    solid, paint = part
    shift, turn = np.asarray(offset, dtype=np.float64), np.eye(3) if R is None else R
    if not callable(paint):
        return moved(solid, shift, turn), paint
    return moved(solid, shift, turn), lambda points: paint((points - shift) @ turn)


def bands(axis: int, limits: Sequence[float], colours: Sequence[Sequence[float]]) -> Paint:
    """Colours by the coordinate along an axis; one more colour than limits."""
    table = np.asarray(colours, dtype=np.float64)
    return lambda vertices: table[np.searchsorted(np.asarray(limits), vertices[:, axis])]


def join(parts: Sequence[Part]) -> Mesh:
    """Paint solids and join them where they are."""
    vertices = np.concatenate([solid[0] for solid, _ in parts])
    starts = np.cumsum([0] + [len(solid[0]) for solid, _ in parts])
    corners = np.concatenate([solid[1] + start for (solid, _), start in zip(parts, starts, strict=False)])
    colours = np.concatenate([_corner_colours(solid, paint) for solid, paint in parts])
    rgb = np.clip(np.rint(colours), 0, 255).astype(np.int64) @ (1 << 16, 1 << 8, 1)
    kinds, faces = np.unique(corners.reshape(-1) * (1 << 24) + rgb, return_inverse=True)
    return Mesh(
        vertices=vertices[kinds >> 24],
        faces=faces.reshape(-1, 3).astype(np.int32),
        colours=np.stack([kinds >> 16, kinds >> 8, kinds], axis=-1).astype(np.uint8),
    )


def _corner_colours(solid: Solid, paint: Paint | Array) -> Array:
    """(3 F, 3) colour at each corner of each face: its vertex's own, but where the face's is another."""
    vertices, faces = solid
    shared = np.asarray(paint(vertices) if callable(paint) else paint, dtype=np.float64)[faces]
    if not callable(paint):
        return shared.reshape(-1, 3)
    corners = vertices[faces]
    inwards = corners.mean(axis=1, keepdims=True) - corners
    length = np.linalg.norm(inwards, axis=-1, keepdims=True)
    inside = corners + inwards * np.minimum(INSET_M / np.maximum(length, 1e-12), 0.3)
    own = np.asarray(paint(inside.reshape(-1, 3)), dtype=np.float64).reshape(corners.shape)
    alike = np.abs(own - shared).max(axis=-1, keepdims=True) < ONE_COLOUR
    return np.where(alike, shared, own).reshape(-1, 3)


def assemble(parts: Sequence[Part]) -> Mesh:
    """As `join`, with the origin moved to the centre of the bounding box."""
    mesh = join(parts)
    centre = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2.0
    return Mesh(mesh.vertices - centre, mesh.faces, mesh.colours)


def within(
    x: tuple[float, float] | None = None,
    y: tuple[float, float] | None = None,
    z: tuple[float, float] | None = None,
) -> Mask:
    """Whether a vertex lies between the limits along each axis."""
    limits = [(axis, limit) for axis, limit in enumerate((x, y, z)) if limit is not None]

    def mask(vertices: Array) -> NDArray[np.bool_]:
        inside = np.ones(len(vertices), dtype=bool)
        for axis, (low, high) in limits:
            inside &= (vertices[:, axis] > low) & (vertices[:, axis] < high)
        return inside

    return mask


def printed(ground: ArrayLike | Paint, *patches: tuple[Mask, ArrayLike | Paint]) -> Paint:
    """A ground with patches on it, the later ones over the earlier."""

    def colours_of(layer: ArrayLike | Paint, vertices: Array) -> Array:
        return layer(vertices) if callable(layer) else np.asarray(layer, dtype=np.float64)

    def paint(vertices: Array) -> Array:
        colours = np.array(np.broadcast_to(colours_of(ground, vertices), vertices.shape), dtype=np.float64)
        for mask, layer in patches:
            inside = mask(vertices)
            colours[inside] = np.broadcast_to(colours_of(layer, vertices), vertices.shape)[inside]
        return colours

    return paint


def grained(colour: ArrayLike, depth: float, axis: int = 0) -> Paint:
    """Wood whose streaks run along an axis; needs no random numbers."""
    along, across, through = (axis, (axis + 1) % 3, (axis + 2) % 3)

    def paint(vertices: Array) -> Array:
        wave = 3.0 * np.sin(5.0 * vertices[:, along])
        streak = np.sin(61.0 * vertices[:, across] + wave) + np.sin(23.0 * vertices[:, through])
        return np.asarray(colour) * (1.0 + depth * streak[:, None])

    return paint
