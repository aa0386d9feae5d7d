import numpy as np
import pytest

from sequences import se3
from sequences.camera import Camera
from sequences.catalogue import Mesh
from sequences.simulation.lighting import Window, corner_normals, light, photograph
from sequences.simulation.solids import assemble, lathe, plain, rounded_box

CAMERA = Camera(150.0, 150.0, 79.5, 59.5, width=160, height=120)
LAMP = np.array([0.0, 0.0, 2.4])
DOWN = np.diag([1.0, -1.0, -1.0])


def slab(size: float, z: float) -> tuple[Mesh, np.ndarray]:
    mesh = assemble([(rounded_box((size, size, 0.02), 0.002), plain((200, 100, 50)))])
    return mesh, se3.make(np.eye(3), np.array([0.0, 0.0, z - 0.01]))


def brightness(image: np.ndarray, x: float, y: float) -> float:
    """Mean red around the picture of the floor's point (x, y), seen from straight above at 2 m."""
    u, v = round(79.5 + 75 * x), round(59.5 - 75 * y)
    return float(image[v - 2 : v + 3, u - 2 : u + 3, 0].mean())


def from_above(*items: tuple[Mesh, np.ndarray], antialias: int = 1, lamp: np.ndarray = LAMP) -> np.ndarray:
    return photograph(light(items, lamp), CAMERA, se3.make(DOWN, np.array([0.0, 0.0, 2.0])), antialias)


def test_a_shadow_lies_beside_what_throws_it_and_nowhere_else():
    lamp = np.array([-1.0, 0.0, 2.0])  # the slab's shadow reaches from x = 0.14 to 0.71, half hidden by the slab
    image, open_floor = from_above(slab(3.0, 0.0), slab(0.4, 0.6), lamp=lamp), from_above(slab(3.0, 0.0), lamp=lamp)
    assert brightness(image, 0.5, 0.0) < 0.75 * brightness(open_floor, 0.5, 0.0)
    for x, y in ((-0.6, 0.0), (0.9, 0.0), (0.5, 0.5), (0.5, -0.5)):
        assert brightness(image, x, y) == pytest.approx(brightness(open_floor, x, y), abs=1.0)


def test_colour_is_the_surfaces_own_under_white_light():
    image = from_above(slab(3.0, 0.0)).astype(float)
    red, green, blue = (image[40:80, 40:120, d].mean() for d in range(3))
    assert red / green == pytest.approx(2.0, rel=0.02)
    assert red / blue == pytest.approx(4.0, rel=0.04)


def daylight(*items: tuple[Mesh, np.ndarray]) -> np.ndarray:
    """The floor from above, dark but for a window a metre wide in the wall x = 1, its sill 0.1 m above the floor."""
    T_world_window = se3.make(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).T, np.array([1.0, 0.0, 0.6]))
    window = Window(T_world_window, np.array([1.0, 1.0]))
    no_lamp = np.array([0.0, 0.0, -5.0])  # below the floor
    return photograph(light(items, no_lamp, window), CAMERA, se3.make(DOWN, np.array([0.0, 0.0, 2.0])), 1)


def test_daylight_fades_into_the_room_and_things_hold_it_off():
    image = daylight(slab(3.0, 0.0))
    at = [brightness(image, x, 0.0) for x in (0.7, 0.4, 0.0, -0.4, -0.8)]
    assert at == sorted(at, reverse=True)
    assert at[0] > 1.3 * at[-1]
    screen, _ = slab(0.5, 0.0)
    upright = se3.make(np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), np.array([0.4, 0.0, 0.25]))
    shaded = daylight(slab(3.0, 0.0), (screen, upright))
    assert brightness(shaded, 0.3, 0.0) < 0.85 * brightness(image, 0.3, 0.0)
    assert brightness(shaded, 0.75, 0.0) == pytest.approx(brightness(image, 0.75, 0.0), abs=2.0)


def test_what_lies_outdoors_is_bright_all_over():
    image = daylight(slab(4.0, 0.0))
    beyond = image[50:70, 157:, 0].astype(float)  # the floor runs on to x = 1.06
    assert beyond.min() > 195
    assert beyond.min() > brightness(image, 0.0, 0.0)


def test_gloss_adds_a_highlight_that_has_the_lights_colour_and_nothing_else():
    ball = lathe([[0.1 * np.sin(t), -0.1 * np.cos(t)] for t in np.linspace(0.0, np.pi, 30)], 40)
    item = (assemble([(ball, plain((120, 20, 20)))]), np.eye(4))
    view = se3.make(DOWN, np.array([0.0, 0.0, 0.6]))
    dull, shiny = (
        photograph(light([item], LAMP, gloss=[gloss]), CAMERA, view, 1).astype(float) for gloss in (0.0, 0.6)
    )
    more = shiny - dull
    assert more.min() >= 0
    assert more[60, 80].min() > 30  # under the lamp, seen from the same side
    np.testing.assert_allclose(more[..., 1], more[..., 2], atol=1.0)
    assert (more[..., 1] > 8).mean() < 0.2 * (dull[..., 0] > 0).mean()


def test_where_nothing_is_the_image_is_black():
    image = from_above(slab(0.2, 0.0))
    assert (image[0, 0] == 0).all()
    assert (image[60, 80] > 0).all()


def test_antialiasing_softens_edges_and_keeps_the_rest():
    plain_image, fine = (from_above(slab(0.7, 0.3), antialias=n).astype(float) for n in (1, 2))
    assert abs(plain_image.mean() - fine.mean()) < 1.0
    assert len(np.unique(fine[:, :, 0])) > len(np.unique(plain_image[:, :, 0]))


def test_normals_are_smooth_round_a_turned_thing_and_break_at_its_rim():
    mesh = assemble([(lathe([[0.0, -0.1], [0.05, -0.1], [0.05, 0.1], [0.0, 0.1]], 24), plain((1, 2, 3)))])
    normals = corner_normals(mesh)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-9)
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    on_wall = np.abs(normals[:, 2]) < 0.5
    radial = corners[on_wall] * [1, 1, 0] / 0.05
    # the wall's two triangles at a corner are not alike, so their mean leans by less than half a segment
    assert np.einsum("ij,ij->i", normals[on_wall], radial).min() > np.cos(np.pi / 24)
    np.testing.assert_allclose(np.abs(normals[~on_wall, 2]), 1.0, atol=1e-9)
