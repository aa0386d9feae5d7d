"""Laws of learning mu: it is found inside its own interval, from truth and from estimates alike."""

import json
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import expit, logit
from typer.testing import CliRunner

from ctmap_gtsam.cli.app import app
from ctmap_gtsam.estimate import Moves
from ctmap_gtsam.learning.persistence import (
    MAX_S,
    MIN_S,
    Gap,
    described,
    gaps_of_estimate,
    gaps_of_truth,
    learn,
)
from factors.persistence import stay_probability
from sequences.bop import load_run, load_truth
from sequences.catalogue import Catalogue
from sequences.errors import InputError
from sequences.simulation import MotionConfig, PlaceConfig, SimulationConfig, TrajectoryConfig
from sequences.simulation.motion import arrange
from sequences.simulation.place import furnish
from tests.ctmap_gtsam import synthetic
from tests.ctmap_gtsam.scenes import classes

HOUR = 3600.0
CATALOGUE = classes("mug", "soup_can")
MUG = next(c.obj_id for c in CATALOGUE.classes if c.name == "mug")


def learned(gaps):
    (one,) = learn(gaps, CATALOGUE, by=lambda c: c.obj_id)
    return one


def drawn(mu_s, n, rng):
    """Gaps of minutes to days of things that move by Equation 3."""
    dt = np.exp(rng.uniform(np.log(0.1 * HOUR), np.log(72 * HOUR), n))
    moved = rng.random(n) >= stay_probability(dt, mu_s)
    return [Gap(MUG, float(t), np.inf if m else -np.inf) for t, m in zip(dt, moved, strict=True)]


@pytest.mark.parametrize("mu_s", [2 * HOUR, 24 * HOUR])
def test_the_interval_holds_mu_as_often_as_it_says(mu_s):
    rng, n = np.random.default_rng(3), 150
    inside = 0
    for _ in range(n):
        low, high = learned(drawn(mu_s, 60, rng)).interval_s
        inside += low <= mu_s <= high
    assert 0.95 - 3.0 * np.sqrt(0.95 * 0.05 / n) <= inside / n


def test_more_gaps_narrow_the_interval():
    rng = np.random.default_rng(0)
    few, many = learned(drawn(6 * HOUR, 30, rng)), learned(drawn(6 * HOUR, 3000, rng))
    assert np.log(many.interval_s[1] / many.interval_s[0]) < 0.3 * np.log(few.interval_s[1] / few.interval_s[0])
    assert many.mu_s == pytest.approx(6 * HOUR, rel=0.15)


def test_what_says_nothing_teaches_nothing():
    """Odds of 1 leave the prior, which is flat in log mu."""
    one = learned([Gap(MUG, 10 * HOUR, 0.0)] * 50)
    span = np.log(MAX_S / MIN_S)
    assert one.mu_s == pytest.approx(np.sqrt(MIN_S * MAX_S), rel=0.02)
    assert np.log(one.interval_s[1] / one.interval_s[0]) == pytest.approx(0.95 * span, rel=0.01)


def test_great_odds_are_certainties():
    rng = np.random.default_rng(1)
    sure = drawn(6 * HOUR, 50, rng)
    nearly = [replace(gap, log_odds=float(np.clip(gap.log_odds, -60.0, 60.0))) for gap in sure]
    a, b = learned(sure), learned(nearly)
    assert a.mu_s == pytest.approx(b.mu_s)
    assert a.interval_s == pytest.approx(b.interval_s)
    assert a.moves == pytest.approx(sum(gap.log_odds > 0 for gap in sure))


def test_only_stays_bound_mu_from_below_and_only_moves_from_above():
    stays, moves = (learned([Gap(MUG, 24 * HOUR, odds)] * 30) for odds in (-np.inf, np.inf))
    assert stays.interval_s[0] > 24 * HOUR
    assert stays.interval_s[1] > 0.3 * MAX_S
    assert moves.interval_s[1] < 24 * HOUR


def test_the_simulators_mu_is_found_inside_its_interval():
    """Of arrangements without swaps of twins, which go by no mu."""
    config = SimulationConfig(
        place=PlaceConfig(objects=10, clutter=0, twins=0),
        motion=MotionConfig(visits=4, swap_twins=0.0),
        trajectory=TrajectoryConfig(frames=2, period_s=2.0),
    )
    gaps, classes_ = [], {}
    for seed in range(40):
        place = furnish(config.place, seed % 8)
        classes_ |= {shape.object_class.obj_id: shape.object_class for shape in place.known.values()}
        for before, after in pairwise(arrange(place, config, seed)):
            taken = {m.inst_id for m in after.moves if m.kind in ("moved", "vanished")}
            dt_s = (after.start_ns - before.start_ns - int(before.times_ns[-1])) * 1e-9
            there = [p.inst_id for p in before.arrangements[-1].things if p.inst_id in place.known]
            gaps += [Gap(place.known[i].object_class.obj_id, dt_s, np.inf if i in taken else -np.inf) for i in there]
    known = Catalogue(tuple(c for _, c in sorted(classes_.items())))
    found = learn(gaps, known, by=lambda c: c.category)
    assert len(found) >= 5
    inside = [one.interval_s[0] <= known[one.obj_ids[0]].persistence_s <= one.interval_s[1] for one in found]
    # of seven at 95 %, one outside is no surprise
    assert sum(inside) >= len(found) - 1


def test_gaps_of_an_estimate_are_free_of_the_mu_that_it_was_made_with():
    """An estimate that knows no more than the prior says nothing of mu."""
    run = SimpleNamespace(catalogue=CATALOGUE)
    dt = 5 * HOUR
    known = CATALOGUE[MUG]
    prior = 1.0 - stay_probability(dt, known.persistence_s)
    evidence = np.array([0.0, 3.0, -4.0])
    probability = expit(logit(prior) + evidence)
    n = len(evidence)
    columns = np.zeros((n, 1, len(CATALOGUE.classes)))
    columns[:, :, CATALOGUE.index(MUG)] = 1.0
    estimate = SimpleNamespace(
        meta={"config": {"prediction": {"stay_limit": 0.5}}},
        class_ids=np.array(CATALOGUE.obj_ids),
        class_probability=columns,
        exists=np.ones((n, 1), dtype=bool),
        moves=Moves(
            np.arange(n),
            np.zeros((n, 2), dtype=np.int64),
            probability,
            np.tile([0, round(dt * 1e9)], (n, 1)),
            np.full(n, -1),
            np.full(n, -1),
        ),
    )
    gaps = gaps_of_estimate(run, estimate)
    np.testing.assert_allclose([gap.log_odds for gap in gaps], evidence, atol=1e-9)
    assert {gap.dt_s for gap in gaps} == {dt}
    with pytest.raises(InputError, match="stay_limit"):
        gaps_of_estimate(run, SimpleNamespace(**{**vars(estimate), "meta": {}}))


def ctmap(*arguments):
    return CliRunner().invoke(app, ["train", "persistence", *map(str, arguments)], prog_name="ctmap")


def test_what_is_learned_can_be_put_into_a_run(tmp_path):
    """Three boxes, untouched for an hour."""
    path = synthetic.write_run(tmp_path / "run", frames=2, visits=2)
    done = ctmap(path, "--out", tmp_path / "catalogue.json")
    assert done.exit_code == 0, done.output
    assert "carton, clay_brick, crate" in done.stdout
    about = json.loads((tmp_path / "catalogue.json").read_text())
    assert {c["persistence_gaps"] for c in about.values()} == {3}
    assert all(
        c["persistence_interval_s"][0] < c["persistence_s"] < c["persistence_interval_s"][1] for c in about.values()
    )
    (path / "catalogue.json").write_text(json.dumps(about))
    before, after = synthetic.catalogue(), load_run(path).catalogue
    assert [c.persistence_s for c in after.classes] == [about[str(c.obj_id)]["persistence_s"] for c in after.classes]
    assert [(c.name, c.category, c.movable) for c in after.classes] == [
        (c.name, c.category, c.movable) for c in before.classes
    ]


def test_the_truths_gaps_are_those_between_visits_and_moves_are_seen_in_the_poses(tmp_path):
    run = load_run(synthetic.write_run(tmp_path / "run", frames=3, visits=2))
    truth = load_truth(run)
    gaps = gaps_of_truth(run, truth)
    assert [(g.obj_id, g.log_odds) for g in gaps] == [(o.obj_id, -np.inf) for o in truth.objects]
    np.testing.assert_allclose([g.dt_s for g in gaps], 3600.0 - 0.2)
    later = truth.objects[1].frames >= 3
    shift = np.where(later, 0.3, 0.0)
    poses = truth.objects[1].T_world_object.copy()
    poses[:, 0, 3] += shift
    carried = replace(truth.objects[1], T_world_object=poses)
    gone = replace(truth.objects[2], **{k: getattr(truth.objects[2], k)[:3] for k in ("frames", "T_world_object")})
    moved = replace(truth, objects=(truth.objects[0], carried, gone))
    assert [g.log_odds for g in gaps_of_truth(run, moved)] == [-np.inf, np.inf, np.inf]


def test_bad_input_is_named(tmp_path):
    path = synthetic.write_run(tmp_path / "run", frames=2, visits=2)
    single = synthetic.write_run(tmp_path / "single", frames=2)
    run = load_run(path)
    meta = {"fingerprint": "other", "config": {"prediction": {"stay_limit": 0.5}}}
    synthetic.estimate_of(run, load_truth(run), meta=meta).save(tmp_path / "other.npz")
    out = ("--out", tmp_path / "catalogue.json")
    for arguments, word in (
        ((single,), "visits"),
        ((path, "--estimate", tmp_path / "other.npz"), "meta.fingerprint"),
        ((tmp_path / "nowhere",), "nowhere"),
    ):
        failed = ctmap(*arguments, *out)
        assert failed.exit_code == 2
        assert word in failed.stderr
        assert "remedy" in failed.stderr
    for file in path.rglob("scene_gt*.json"):
        file.unlink()
    failed = ctmap(path, *out)
    assert failed.exit_code == 2
    assert "--estimate" in failed.stderr
    assert not (tmp_path / "catalogue.json").exists()


def test_described_keeps_what_was_not_learned():
    (one,) = learn([Gap(MUG, 3600.0, -np.inf)], CATALOGUE, by=lambda c: c.obj_id)
    about = described(CATALOGUE, [one])
    other = next(c for c in CATALOGUE.classes if c.obj_id != MUG)
    assert about[str(other.obj_id)]["persistence_s"] == other.persistence_s
    assert about[str(MUG)]["persistence_s"] == one.mu_s
