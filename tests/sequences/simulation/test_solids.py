import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from sequences.simulation import solids
from sequences.simulation.solids import Solid
from tests.sequences.simulation.solid_geometry import distances

SOLIDS = {
    "box": solids.rounded_box((0.2, 0.1, 0.05), 0.01),
    "bottle": solids.lathe([[0.0, 0.0], [0.04, 0.0], [0.04, 0.1], [0.015, 0.15], [0.0, 0.15]], 20),
    "bar": solids.tube([[0.0, 0.0, 0.0], [0.1, 0.0, 0.02], [0.2, 0.0, 0.0]], [0.02, 0.03, 0.01], 14),
    "roll": solids.ring([[0.03, -0.05], [0.06, -0.05], [0.06, 0.05], [0.03, 0.05]], 24),
    "bolster": solids.stacked([[0.05, 0.03, 0.0], [0.06, 0.04, 0.02, 0.01], [0.05, 0.03, 0.05, 0.0, 0.01]], power=4.0),
    "puff": solids.puff((0.1, 0.12, 0.08), lambda d: 1.0 + 0.1 * np.sin(5.0 * d[:, 0])),
    "block": solids.block((0.1, 0.2, 0.3), (0.4, 0.5, 0.6)),
}
every_solid = pytest.mark.parametrize("solid", SOLIDS.values(), ids=SOLIDS)


def measured(solid: Solid) -> trimesh.Trimesh:
    return trimesh.Trimesh(*solid, process=False)


@every_solid
def test_what_the_builders_make_is_closed_and_faces_outwards(solid):
    mesh = measured(solid)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    assert mesh.area_faces.min() > 0


def test_measures_are_as_stated():
    angle = 2 * np.pi / 24
    polygon = 24 * np.sin(angle) / 2  # area of the regular polygon of 24 corners in a unit circle
    assert measured(SOLIDS["roll"]).volume == pytest.approx(polygon * (0.06**2 - 0.03**2) * 0.1)
    assert measured(SOLIDS["block"]).volume == pytest.approx(0.1 * 0.2 * 0.3)
    np.testing.assert_allclose(measured(SOLIDS["block"]).centroid, [0.4, 0.5, 0.6])
    np.testing.assert_allclose(np.ptp(SOLIDS["box"][0], axis=0), [0.2, 0.1, 0.05], atol=1e-9)


@given(power=st.floats(2.0, 12.0), n=st.integers(8, 48))
def test_a_superellipse_fulfils_its_equation(power, n):
    points = solids.superellipse(0.3, 0.1, power, n)
    np.testing.assert_allclose((np.abs(points / (0.3, 0.1)) ** power).sum(axis=1), 1.0, rtol=1e-9)


@every_solid
@settings(max_examples=12)
@given(
    normal=st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda n: np.linalg.norm(n) > 0.1), share=st.floats(0.1, 0.9)
)
def test_scoring_leaves_the_surface_as_it_is(solid, normal, share):
    normal = np.array(normal) / np.linalg.norm(normal)
    level = solid[0] @ normal
    place = float(level.min() + share * np.ptp(level))
    scored = solids.scored(solid, normal, [place])
    mesh = measured(scored)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(measured(solid).volume)
    assert mesh.area == pytest.approx(measured(solid).area)
    new = scored[0][len(solid[0]) :]
    if len(new):
        assert distances(new, *solid).max() < 1e-9
    # no face reaches over the place
    reach = scored[0][scored[1]] @ normal - place
    assert not ((reach.min(axis=1) < -1e-5) & (reach.max(axis=1) > 1e-5)).any()


def test_paint_moves_with_its_solid():
    box = SOLIDS["box"]
    halves = solids.bands(2, [0.0], [(255, 0, 0), (0, 0, 255)])
    R, shift = solids.rotation("x", 180.0), np.array([0.0, 0.0, 5.0])
    turned, paint = solids.placed((box, halves), shift, R)
    np.testing.assert_allclose(turned[0], box[0] @ R.T + shift)
    np.testing.assert_array_equal(paint(turned[0]), halves(box[0]))
    _, colours = solids.placed((box, halves(box[0])), shift, R)
    np.testing.assert_array_equal(colours, halves(box[0]))


@every_solid
@settings(max_examples=8)
@given(share=st.floats(0.2, 0.8))
def test_colours_meet_at_a_line_and_each_face_has_one(solid, share):
    place = float(solid[0][:, 2].min() + share * np.ptp(solid[0][:, 2]))
    scored = solids.scored(solid, 2, [place])
    mesh = solids.join([(scored, solids.bands(2, [place], [(200, 0, 0), (0, 0, 200)]))])
    colours = mesh.colours[mesh.faces].astype(int)
    assert (np.ptp(colours, axis=1) == 0).all()
    middle = mesh.vertices[mesh.faces].mean(axis=1)[:, 2]
    clear = np.abs(middle - place) > 1e-3
    np.testing.assert_array_equal(colours[clear, 0, 0] > 0, middle[clear] < place)
    assert {tuple(v) for v in mesh.vertices} == {tuple(v) for v in scored[0][np.unique(scored[1])]}
    assert mesh.is_solid == solids.join([(solid, solids.plain((1, 1, 1)))]).is_solid


def test_shades_are_blended_over_a_face():
    solid = SOLIDS["box"]
    mesh = solids.join([(solid, lambda v: 100.0 + 800.0 * v)])
    assert len(mesh.vertices) == len(solid[0])
    given = solids.join([(solid, np.full((len(solid[0]), 3), 7.0))])
    np.testing.assert_array_equal(given.colours, 7)


def test_later_patches_are_printed_over_earlier_ones():
    vertices = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    paint = solids.printed(
        (1, 1, 1), (solids.within(x=(0.5, 3.0)), (2, 2, 2)), (solids.within(x=(1.5, 3.0)), solids.plain((3, 3, 3)))
    )
    np.testing.assert_array_equal(paint(vertices)[:, 0], [1, 2, 3])
    assert not solids.within(x=(0.5, 3.0), y=(1.0, 2.0))(vertices).any()
