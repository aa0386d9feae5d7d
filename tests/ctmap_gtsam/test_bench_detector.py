import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from ctmap_gtsam.bench import detector as bench
from ctmap_gtsam.cli.app import app
from ctmap_gtsam.config import Config
from ctmap_gtsam.evaluation.record import pooled, record
from sequences.bop import load_run, load_truth
from sequences.simulation import DetectorConfig, simulate_place
from sequences.simulation.detections import Detector
from sequences.simulation.simulator import watch_place
from tests.sequences.simulation.conftest import TINY

SMALL = replace(TINY, sensor=replace(TINY.sensor, width=160))


def test_what_is_watched_is_what_is_simulated(tmp_path):
    """Detections and mAP without depth and colour are those of the run."""
    simulate_place(tmp_path / "run", SMALL, 2)
    run = load_run(tmp_path / "run")
    truth = load_truth(run)
    assert truth is not None
    watched = watch_place(SMALL, 2)
    found = []
    for v, (n, glimpses) in enumerate(watched.visits):
        camera = SMALL.sensor.camera
        detector = Detector(watched.classes, (camera.width, camera.height), SMALL.detector, 2, v, watched.obj_ids, n)
        found += [detector.detect(k, g.recognisable, g.around) for k, g in enumerate(glimpses)]
    assert sum(map(len, found)) > 10
    for frame, said in zip(run.frames, found, strict=True):
        assert sorted(d.box for d in frame.detections) == sorted(d.box for d in said)
    (boxes,) = bench.judge(watch_place(SMALL, 2), [SMALL.detector], 2)
    table = record(run, truth, "detector", None)
    assert bench.mean_average_precision(boxes) == pytest.approx(pooled([table])["map_50"], abs=0.03)


def test_more_noise_gives_less_precision():
    config = replace(Config(), simulation=SMALL)
    figures = bench.run(config, seeds=(0,))
    values = [value for name, value in figures.items() if name.startswith("detector.map_50_at_")]
    assert len(values) == len(bench.KNOBS)
    assert values[0] > values[-1]
    perfect = replace(Config(), simulation=replace(SMALL, detector=DetectorConfig(noise=0.0)))
    assert set(bench.run(perfect, seeds=(0,)).values()) == {1.0, None}


def test_the_knob_lies_between_its_neighbours():
    assert bench._where(0.6, [(0.7, 1.0), (0.5, 2.0)]) == pytest.approx(1.5)
    assert bench._where(0.6, [(0.5, 1.0), (0.4, 2.0)]) is None
    assert bench._where(0.6, []) is None
    assert np.isfinite(bench.PAPER)


def test_the_command_writes_the_figures(tmp_path):
    options = ["--seeds", "3", "--json", str(tmp_path / "d.json"), "--set", "simulation.sensor.width=160"]
    done = CliRunner().invoke(app, ["bench", "detector", *options])
    assert done.exit_code == 0, done.output
    result = json.loads((tmp_path / "d.json").read_text())
    assert result["name"] == "detector"
    noise = Config().simulation.detector.noise
    assert 0.2 < result["figures"][f"detector.map_50_at_{noise:.3g}"] < 1.0
