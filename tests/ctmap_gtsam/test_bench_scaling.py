"""What `ctmap bench filter` and `ctmap bench smooth` measure is the estimators on one long run."""

import json
from dataclasses import replace

import numpy as np
import pytest

from ctmap_gtsam.bench import run_bench
from ctmap_gtsam.bench.scaling import parts as scaling_parts
from ctmap_gtsam.bench.scaling.loop import looped, write_loop
from ctmap_gtsam.bench.scaling.measuring import Measured, forward, measure, peak_mb, with_particles
from ctmap_gtsam.bench.scaling.sizes import QUICK
from sequences.bop import load_run
from tests.ctmap_gtsam.scenes import CHEAP, config_of

CONFIG = config_of(*CHEAP, "frontend.fresh_poses=20", "frontend.refined_poses=4")
TINY = replace(QUICK, objects=(1,), particles=(60,), lengths=(20, 40), length_objects=1, keyframes=16, round_frames=3)


@pytest.fixture(scope="module")
def loop(tmp_path_factory):
    folder = tmp_path_factory.mktemp("loop") / "run"
    write_loop(folder, 2, seed=0, frames=5)
    return folder


def test_a_long_run_is_one_round_again_and_again_at_later_times(loop):
    run = load_run(loop)
    frames = looped(run, 13).frames
    assert len(frames) == 13
    assert [f.index for f in frames] == list(range(13))
    assert (np.diff([f.time_ns for f in frames]) == frames[1].time_ns - frames[0].time_ns).all()
    np.testing.assert_array_equal(frames[12].read_depth(), run.frames[2].read_depth())
    assert frames[12].depth_path == run.frames[2].depth_path


def test_all_that_stands_on_the_table_is_in_view(loop):
    run = load_run(loop)
    assert all(len(frame.detections) == 2 for frame in run.frames)
    for frame in run.frames:
        depth = frame.read_depth()
        for x, y, w, h in (d.box for d in frame.detections):
            assert depth[int(y + h / 2), int(x + w / 2)] > 0


def test_the_seed_decides_the_round(loop, tmp_path):
    write_loop(tmp_path / "same", 2, seed=0, frames=5)
    write_loop(tmp_path / "other", 2, seed=1, frames=5)
    first = load_run(loop).fingerprint
    assert load_run(tmp_path / "same").fingerprint == first
    assert load_run(tmp_path / "other").fingerprint != first


def test_a_process_of_its_own_is_measured(loop):
    measured = measure("filter", loop, 6, with_particles(CONFIG, 40))
    assert len(measured.each_s) == 6
    assert 0.0 < sum(measured.each_s) <= measured.seconds
    assert 50.0 < measured.peak_mb < 10 * peak_mb()
    assert measured.objects >= 1
    after = measure("smooth", loop, 6, with_particles(CONFIG, 40))
    assert after.seconds > 0.0
    assert 1 <= after.objects <= measured.objects


def pretended(method, folder, keyframes, config):
    """A machine on which a keyframe takes 0.1 s, the first ten 1 s, the smoother twice that, and memory grows."""
    each = tuple([1.0] * min(keyframes, 10) + [0.1] * (keyframes - 10))
    assert folder.is_dir()
    assert method == "filter" or forward(folder, keyframes).exists()
    forward(folder, keyframes).touch()
    return Measured(sum(each) * (2.0 if method == "smooth" else 1.0), each, 100.0 + keyframes, 1)


@pytest.mark.parametrize("name", ["filter", "smooth"])
def test_figures_are_of_what_was_measured(monkeypatch, name):
    monkeypatch.setattr(scaling_parts, "measure", pretended)
    figures = run_bench(name, config_of("frontend.start_after=3"), sizes=TINY)["figures"]
    json.dumps(figures, allow_nan=False)
    factor = 2.0 if name == "smooth" else 1.0
    assert figures[f"{name}.seconds_per_keyframe_20"] == pytest.approx(factor * 11.0 / 20)
    assert figures[f"{name}.seconds_per_keyframe_40"] == pytest.approx(factor * 13.0 / 40)
    assert figures[f"{name}.seconds_long_over_short"] == pytest.approx((13.0 / 40) / (11.0 / 20))
    assert figures[f"{name}.memory_long_over_short"] == pytest.approx(140.0 / 120.0)
    assert figures[f"{name}.kb_per_keyframe"] == pytest.approx(1024.0)
    if name == "smooth":
        assert figures["smooth.over_filter_1_objects"] == pytest.approx(2.0)
        assert figures["smooth.over_filter_40_keyframes"] == pytest.approx(2.0)
    else:
        assert figures["filter.keyframes_per_s_1_objects"] == pytest.approx(10 / (4 * 1.0 + 6 * 0.1))
        assert figures["filter.start_s_1_objects"] == pytest.approx(6.0)
        assert figures["filter.late_over_early"] == pytest.approx(1.0)


def test_what_was_measured_before_it_was_stopped_is_not_measured_again(monkeypatch, tmp_path):
    asked = []

    def counted(method, folder, keyframes, config):
        asked.append((method, keyframes, config.filter.particles))
        if len(asked) == 3:
            raise KeyboardInterrupt
        return pretended(method, folder, keyframes, config)

    monkeypatch.setattr(scaling_parts, "measure", counted)
    with pytest.raises(KeyboardInterrupt):
        run_bench("filter", CONFIG, sizes=TINY, keep=tmp_path)
    whole = run_bench("filter", CONFIG, sizes=TINY, keep=tmp_path)["figures"]
    assert asked[2:] == [("filter", 20, 60)] * 2 + [("filter", 40, 60)]
    assert run_bench("filter", CONFIG, sizes=TINY, keep=tmp_path)["figures"] == whole
    assert len(asked) == 5
    run_bench("smooth", CONFIG, sizes=TINY, keep=tmp_path)
    assert all(method == "smooth" for method, *_ in asked[5:])
    run_bench("filter", config_of(*CHEAP, "filter.particles=77"), sizes=TINY, keep=tmp_path)
    assert ("filter", 16, 77) in asked
