import numpy as np
import pytest

from sequences import se3
from sequences.camera import Camera
from sequences.rendering.scene import render_scene
from sequences.simulation.visibility import Thing, look
from tests.tiny import box_mesh

CAMERA = Camera(150.0, 150.0, 79.5, 59.5, width=160, height=120)


def seen(*boxes: tuple[float, float, float]) -> list:
    """Cubes of 20 cm with their middles at x, y, z metres before the camera."""
    mesh = box_mesh(0.2, 0.2, 0.2)
    things = [Thing(k, 5, mesh, se3.make(np.eye(3), np.array(at))) for k, at in enumerate(boxes)]
    images = render_scene([(t.mesh, t.T_camera_object) for t in things], CAMERA)
    return look(things, images.item, CAMERA)


def test_a_box_encloses_the_visible_pixels():
    (one,) = seen((0.0, 0.0, 1.0))
    half = 150.0 * 0.1 / 0.9  # the front face, half a pixel wider at most
    np.testing.assert_allclose(one.box, (79.5 - half, 59.5 - half, 2 * half, 2 * half), atol=1.01)
    assert one.fraction == pytest.approx(1.0, abs=0.02)
    assert one.unoccluded == pytest.approx(1.0, abs=0.02)


def test_what_is_hidden_shows_less_of_its_silhouette():
    behind, before = seen((0.0, 0.0, 1.5), (0.1, 0.0, 0.8))
    assert before.fraction == pytest.approx(1.0, abs=0.02)
    assert behind.fraction == pytest.approx(0.5, abs=0.15)
    assert behind.fraction == pytest.approx(behind.unoccluded, abs=0.02)
    assert behind.box[2] < 0.75 * behind.box[3]


def test_what_the_images_edge_cuts_is_not_occluded():
    (cut,) = seen((0.53, 0.0, 1.0))
    assert cut.fraction == pytest.approx(0.5, abs=0.1)
    assert cut.unoccluded == pytest.approx(1.0, abs=0.03)
    assert cut.box[0] + cut.box[2] == 160.0


def test_what_does_not_show_has_no_box():
    _, hidden, outside = seen((0.0, 0.0, 0.5), (0.0, 0.0, 2.0), (5.0, 0.0, 1.0))
    for one in (hidden, outside):
        assert one.box == (0.0, 0.0, 0.0, 0.0)
        assert one.fraction == one.unoccluded == one.evidence == 0.0


def test_pixels_of_other_items_are_nobodys():
    mesh = box_mesh(0.2, 0.2, 0.2)
    thing = Thing(1, 5, mesh, se3.make(np.eye(3), np.array([0.0, 0.0, 1.5])))
    wall = (mesh, se3.make(np.eye(3), np.array([0.1, 0.0, 0.8])))
    images = render_scene([(mesh, thing.T_camera_object), wall], CAMERA)
    (one,) = look([thing], images.item, CAMERA)
    assert one.fraction == pytest.approx(0.5, abs=0.15)
