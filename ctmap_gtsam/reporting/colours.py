"""One palette for everything drawn, told apart by colour-blind readers too.

Okabe and Ito, Color Universal Design (2008), then tones of Tol, Colour Schemes (SRON/EPS/TN/09-002, 2021).
"""

from __future__ import annotations

from sequences.catalogue import Catalogue

RGB = tuple[int, int, int]

FILTER = "#d55e00"
SMOOTHER = "#0072b2"
QUIET = "#8a8f98"

CLASSES: tuple[RGB, ...] = (
    (0, 114, 178),
    (230, 159, 0),
    (0, 158, 115),
    (204, 121, 167),
    (86, 180, 233),
    (213, 94, 0),
    (240, 228, 66),
    (51, 34, 136),
    (136, 34, 85),
    (170, 170, 0),
    (238, 136, 102),
    (68, 187, 153),
    (153, 221, 255),
    (140, 86, 75),
    (17, 119, 51),
    (255, 157, 167),
    (110, 110, 110),
    (196, 176, 140),
)


def class_colours(catalogue: Catalogue) -> dict[int, RGB]:
    """obj_id -> RGB, the same in every picture of a catalogue; they come round again after len(CLASSES) classes."""
    return {obj_id: CLASSES[k % len(CLASSES)] for k, obj_id in enumerate(catalogue.obj_ids)}


def css(colour: RGB) -> str:
    """As #rrggbb."""
    return "#{:02x}{:02x}{:02x}".format(*colour)
