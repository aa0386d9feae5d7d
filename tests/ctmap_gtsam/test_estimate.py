"""The result type: what it says of poses, and that what is on disk is what docs/format.md describes."""

import json
import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from ctmap_gtsam.estimate import Estimate, Modes
from sequences import se3
from sequences.bop import load_run, load_truth
from sequences.errors import InputError
from tests.ctmap_gtsam import synthetic

FORMAT = Path(__file__).parents[2] / "docs" / "format.md"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return load_run(synthetic.write_run(tmp_path_factory.mktemp("run") / "small", frames=4))


@pytest.fixture
def estimate(run):
    return synthetic.estimate_of(run, load_truth(run))


def arrays(estimate):
    found = {f.name: getattr(estimate, f.name) for f in fields(estimate) if f.name != "meta"}
    for table in ("modes", "moves", "ledger"):
        part = found.pop(table)
        found |= {f"{table}.{f.name}": getattr(part, f.name) for f in fields(part)}
    return found


def test_what_is_saved_is_loaded(estimate, tmp_path):
    estimate.save(tmp_path / "e.npz")
    loaded = Estimate.load(tmp_path / "e.npz")
    for name, value in arrays(estimate).items():
        np.testing.assert_array_equal(arrays(loaded)[name], value)
        assert arrays(loaded)[name].dtype == value.dtype
    assert loaded.meta == {**estimate.meta, "schema": 1}
    loaded.save(tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == (tmp_path / "e.npz").read_bytes()


def test_numpy_alone_reads_what_the_docs_describe(estimate, tmp_path):
    estimate.save(tmp_path / "smooth-ct.npz")
    code = re.search(r"```python\n(.*?)```", FORMAT.read_text(), re.DOTALL)[1]
    scope = {}
    exec(code.replace("smooth-ct.npz", str(tmp_path / "smooth-ct.npz")), scope)
    # tables of the meta data come after those of the arrays
    arrays_alone = FORMAT.read_text().split("`diagnostics` of")[0]
    rows = re.findall(r"^\| `([a-zA-Z_.]+)` \| (\([^)]*\))( bool)? \|", arrays_alone, re.MULTILINE)
    described = {name: (shape, kind) for name, shape, kind in rows}
    found = scope["estimate"]
    assert set(described) | {"meta"} == set(found)
    sizes = {"N": 3, "K": 4, "C": 3, "M": 12, "G": 0, "L": 0}
    for name, (shape, kind) in described.items():
        expected = tuple(sizes[s] if s in sizes else int(s) for s in re.findall(r"\w+", shape))
        assert found[name].shape == expected, name
        assert found[name].dtype.kind in ("b" if kind else "if"), name
    assert scope["meta"]["schema"] == 1


@pytest.mark.parametrize("damage", ["truncated", "not a zip", "other schema", "missing array"])
def test_a_broken_file_is_named(estimate, tmp_path, damage):
    path = tmp_path / "e.npz"
    estimate.save(path)
    if damage == "truncated":
        path.write_bytes(path.read_bytes()[:1000])
    elif damage == "not a zip":
        path.write_text("hello")
    else:
        with np.load(path) as archive:
            content = dict(archive)
        if damage == "other schema":
            content["meta"] = np.array(json.dumps({"schema": 99}))
        else:
            del content["modes.log_weight"]
        np.savez(path, **content)
    with pytest.raises(InputError, match="estimate") as caught:
        Estimate.load(path)
    assert caught.value.file == path
    assert caught.value.remedy


def with_modes(estimate, rows, class_probability):
    """One object, one keyframe: rows of (class_id, weight, x)."""
    n = len(rows)
    return Estimate(
        **{
            **{f.name: getattr(estimate, f.name) for f in fields(estimate)},
            "object_id": np.array([1]),
            "class_probability": np.array(class_probability, dtype=float).reshape(1, 1, 3),
            "existence": np.ones((1, 1)),
            "in_view": np.ones((1, 1), bool),
            "keyframe_frame": np.array([0]),
            "T_world_camera": np.eye(4)[None],
            "modes": Modes(
                np.zeros(n, int),
                np.zeros(n, int),
                np.array([r[0] for r in rows]),
                np.log([r[1] for r in rows]),
                se3.make(np.eye(3), np.array([[r[2], 0, 0] for r in rows], float)),
                np.tile(np.eye(6), (n, 1, 1)),
                np.zeros((n, 6, 3)),
            ),
        }
    )


def test_the_pose_is_the_heaviest_mode_of_the_most_probable_class(estimate):
    rows = [(3, 0.9, 1.0), (5, 0.4, 2.0), (5, 0.6, 3.0), (3, 0.1, 4.0)]
    one = with_modes(estimate, rows, [0.4, 0.6, 0.0])
    assert one.best_class[0, 0] == 5
    assert one.pose[0, 0, 0, 3] == 3.0
    assert with_modes(estimate, rows, [0.6, 0.4, 0.0]).pose[0, 0, 0, 3] == 1.0


def test_ties_go_to_the_earlier_row(estimate):
    one = with_modes(estimate, [(5, 0.5, 1.0), (5, 0.5, 2.0)], [0, 1, 0])
    assert one.pose[0, 0, 0, 3] == 1.0


def test_without_a_mode_of_its_class_an_object_is_not_in_the_map(estimate):
    one = with_modes(estimate, [(3, 1.0, 1.0)], [0.4, 0.6, 0.0])
    assert not one.exists.any()
    assert np.isnan(one.pose).all()
    assert len(one.at_keyframe(0).objects) == 0


def test_the_map_is_held_and_the_camera_carried(run):
    truth = load_truth(run)
    off = se3.exp(np.array([0.01, 0.02, 0, 0.1, 0, 0]))
    sparse = synthetic.estimate_of(run, truth, keyframes=[0, 2], cameras=truth.T_world_camera @ off)
    frame = run.frames[3]
    snapshot = sparse.at(frame.time_ns, frame.T_world_camera)
    assert snapshot.keyframe == 1
    # the recorded cameras are true here, so the estimated one stays off by the motion that it was off by
    expected = truth.T_world_camera[2] @ off @ se3.inverse(truth.T_world_camera[2]) @ truth.T_world_camera[3]
    np.testing.assert_allclose(snapshot.T_world_camera, expected, atol=1e-12)
    np.testing.assert_allclose(snapshot.score, synthetic.RIGHT)
    assert sparse.at(0).keyframe == 0


def test_shapes_that_differ_are_refused(estimate):
    values = {f.name: getattr(estimate, f.name) for f in fields(estimate)}
    with pytest.raises(ValueError, match="existence"):
        Estimate(**{**values, "existence": np.zeros((1, 1))})


def test_an_empty_map_is_an_estimate(run, tmp_path):
    empty = synthetic.unplaced(synthetic.estimate_of(run, load_truth(run)), [0, 1, 2])
    empty.save(tmp_path / "e.npz")
    assert len(Estimate.load(tmp_path / "e.npz").at(run.frames[1].time_ns).objects) == 0
