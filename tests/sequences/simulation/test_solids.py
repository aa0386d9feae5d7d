import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from sequences.simulation import solids
from sequences.simulation.solids import SEAM_M, Solid
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
def test_scoring_leaves_the_surface_as_it_is_and_lets_colours_change_sharply(solid, normal, share):
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
    # a face reaches over the place by no more than the seam
    reach = scored[0][scored[1]] @ normal - place
    over = (reach.min(axis=1) < -1e-5) & (reach.max(axis=1) > 1e-5)
    assert np.ptp(reach[over], axis=1).max(initial=0.0) < SEAM_M + 1e-5


def test_paint_that_is_baked_moves_with_its_solid():
    box = SOLIDS["box"]
    halves = solids.bands(2, [0.0], [(255, 0, 0), (0, 0, 255)])
    turned = solids.moved(box, (0.0, 0.0, 5.0), solids.rotation("x", 180.0))
    np.testing.assert_array_equal(solids.baked(halves, box)(turned[0]), halves(box[0]))
    assert not np.array_equal(halves(turned[0]), halves(box[0]))


def test_later_patches_are_printed_over_earlier_ones():
    vertices = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    paint = solids.printed(
        (1, 1, 1), (solids.within(x=(0.5, 3.0)), (2, 2, 2)), (solids.within(x=(1.5, 3.0)), solids.plain((3, 3, 3)))
    )
    np.testing.assert_array_equal(paint(vertices)[:, 0], [1, 2, 3])
    assert not solids.within(x=(0.5, 3.0), y=(1.0, 2.0))(vertices).any()
