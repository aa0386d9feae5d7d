"""The smoother's graph for people: nothing is lost on the way, and what a format can't hold is said."""

import csv
import io
import re

import gtsam
import matplotlib.image
import numpy as np
import pytest

from ctmap_gtsam.export.graph import dot, factor_table, g2o, picture, write_graph
from ctmap_gtsam.model import Model
from ctmap_gtsam.smoothing.graph import Camera, Measured, Variable, bias_key, build, camera_key, object_key, smooth
from sequences import se3
from sequences.types import LocalisationNoise
from tests.ctmap_gtsam.scenes import classes, config_of

CONFIG = config_of(
    "context.relations.same_category.strength=0.6",
    "sensor.bias_rotation_rad=1e-6",
    "sensor.bias_translation_m=1e-7",
    "sensor.bias_surface_m=0",
    "sensor.bias_size=0",
)
K = 6


def solved(names=("cereal_box", "soup_can")):
    """Two things, seen in six keyframes of two visits; the first one moves in between."""
    rng = np.random.default_rng(0)
    model = Model(classes(*names), CONFIG)
    cameras = [Camera(se3.exp(0.1 * rng.normal(size=6)), 0.3 * k, k // 3) for k in range(K)]
    objects = {}
    for row, shape in enumerate(sorted(model.shapes, key=lambda shape: shape.source.name)):
        T = se3.make(np.eye(3), np.array([0.2 * row, 0, 1.0]))
        sigma = np.repeat([0.02, 0.004], 3)
        seen = [se3.inverse(c.T_world_camera) @ T @ se3.exp(rng.normal(size=6) * sigma) for c in cameras]
        objects[2 + row] = (
            shape,
            [
                Measured(k, c.time_s, c.visit, seen[k], np.diag(sigma**2), stays=k > 0 and (row > 0 or k != 3))
                for k, c in enumerate(cameras)
            ],
        )
    built = build(model, cameras, LocalisationNoise(0.003, 0.004, 3.0), objects)
    return built, smooth(built, model, K).solution.values


@pytest.fixture(scope="module")
def graph():
    return solved()


def test_keys_are_read_back():
    assert str(Variable.of(camera_key(7))) == "x7"
    assert str(Variable.of(object_key(12, 345))) == "o12k345"
    assert str(Variable.of(bias_key(3, 1))) == "b3v1"
    assert (Variable.of(bias_key(3, 1)).row, Variable.of(camera_key(7)).row) == (3, None)


def test_the_table_holds_every_factor_and_its_errors_sum_to_the_graphs(graph):
    built, values = graph
    rows = list(csv.DictReader(io.StringIO(factor_table(built, values))))
    assert len(rows) == built.to_gtsam().size()
    assert sum(float(row["error_nats"]) for row in rows) == pytest.approx(built.to_gtsam().error(values), rel=1e-7)
    kinds = [row["kind"] for row in rows]
    assert {kind: kinds.count(kind) for kind in kinds} == built.count()
    assert {row["keys"] for row in rows if row["kind"] == "context"} == {f"o2k{k} o3k{k}" for k in range(K)}
    assert {row["keys"] for row in rows if row["name"] == "object 3 keyframe 4"} >= {"x4 o3k4 b3v1", "o3k3 o3k4"}


def test_dot_joins_each_factor_to_its_variables(graph):
    built, values = graph
    text = dot(built, values)
    joined = re.findall(r'f(\d+) -- "(\w+)"', text)
    expected = [(str(i), str(Variable.of(key))) for i, label in enumerate(built.labels) for key in label.keys]
    assert sorted(joined) == sorted(expected)
    nodes = re.findall(r'^  "(\w+)" \[shape=circle', text, re.MULTILINE)
    assert sorted(nodes) == sorted(str(Variable.of(key)) for key in built.initial.keys())  # noqa: SIM118
    assert text.count("{") == text.count("}") == 1


def read_g2o(text, path):
    path.write_text(text)
    return gtsam.readG2o(str(path), True)


def test_g2o_is_the_measurements_and_predictions_and_says_what_it_leaves_out(tmp_path):
    """Read by GTSAM: the same poses, and the same errors where nothing is symmetric and no bias worth speaking of."""
    built, values = solved(("mug",))
    text = g2o(built, values)
    edges, poses = read_g2o(text, tmp_path / "graph.g2o")
    count = built.count()
    assert edges.size() == count["measurement"] + count["prediction"]
    assert text.startswith(f"# left out: {count['localisation']} localisation, {count['bias']} bias\n")
    names = dict(re.findall(r"^# (\d+) (\w+)$", text, re.MULTILINE))
    assert sorted(names.values()) == sorted([f"x{k}" for k in range(K)] + [f"o2k{k}" for k in range(K)])
    for number, name in names.items():
        key = camera_key(int(name[1:])) if name[0] == "x" else object_key(2, int(name[3:]))
        np.testing.assert_allclose(poses.atPose3(int(number)).matrix(), values.atPose3(key).matrix(), atol=1e-9)
    ours = [
        e
        for label, e in zip(built.labels, built.errors(values), strict=True)
        if label.kind in ("measurement", "prediction")
    ]
    theirs = [edges.at(i).error(poses) for i in range(edges.size())]
    np.testing.assert_allclose(sorted(theirs), sorted(ours), rtol=1e-3, atol=1e-6)


def test_edges_of_a_symmetric_thing_have_its_errors(graph):
    """Whatever image its poses are written in; free axes have no information."""
    built, values = graph
    turned = gtsam.Values(values)
    flip = se3.make(np.diag([1.0, -1.0, -1.0]), np.zeros(3)) @ se3.exp(np.array([0, 0, 0.7, 0, 0, 0]))
    for k in (1, 4):
        turned.update(object_key(3, k), gtsam.Pose3(values.atPose3(object_key(3, k)).matrix() @ flip))
    for some in (values, turned):
        errors = dict(zip(((label.kind, label.keys[:2]) for label in built.labels), built.errors(some), strict=True))
        for edges in built.edges(some):
            for keys, T, information in zip(edges.keys.tolist(), edges.T, edges.information, strict=True):
                a, b = (some.atPose3(key).matrix() for key in keys)
                r = se3.log(se3.inverse(T) @ se3.inverse(a) @ b)
                assert 0.5 * r @ information @ r == pytest.approx(errors[edges.kind, tuple(keys)], rel=0.02, abs=1e-4)


def test_the_picture_has_a_row_a_thing_and_a_dot_a_measurement(graph):
    built, values = graph
    axes = picture(built, values).axes[0]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["camera", "cereal_box 2", "soup_can 3"]
    dots = np.concatenate([c.get_offsets() for c in axes.collections if hasattr(c, "get_sizes")])
    for k in range(K):
        assert ([k, 1] == dots).all(axis=-1).any()
        assert ([k, 2] == dots).all(axis=-1).any()
    lines = [segment for c in axes.collections if hasattr(c, "get_segments") for segment in c.get_segments()]
    along = {tuple(np.sort(s[:, 0])) for s in lines if (s[:, 1] == 1).all()}
    assert along == {(0.0, 1.0), (1.0, 2.0), (3.0, 4.0), (4.0, 5.0)}


def test_all_are_written(graph, tmp_path):
    built, values = graph
    written = write_graph(tmp_path / "new" / "folder", built, values)
    assert {path.name for path in written} == {"factors.csv", "graph.dot", "graph.g2o", "graph.png"}
    assert (tmp_path / "new" / "folder" / "factors.csv").read_text() == factor_table(built, values)
    assert matplotlib.image.imread(tmp_path / "new" / "folder" / "graph.png").shape[0] > 100


def test_a_graph_without_objects_can_be_looked_into(tmp_path):
    model = Model(classes("mug"), CONFIG)
    built = build(model, [Camera(np.eye(4), 0.0, 0)], LocalisationNoise(), {})
    assert len(write_graph(tmp_path, built, built.initial)) == 4
