"""Laws of learning relations: what the simulator draws is found, and shuffled categories teach nothing."""

import itertools
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from typer.testing import CliRunner

from ctmap_gtsam.cli.app import app
from ctmap_gtsam.config import load_config
from ctmap_gtsam.learning.context import (
    Pair,
    Standing,
    learn,
    pairs_of,
    relations_of,
    standings_of_estimate,
    standings_of_truth,
)
from ctmap_gtsam.model import Model
from factors.context import context_log_ratio, relation_table
from sequences import se3
from sequences.bop import load_run, load_truth
from sequences.catalogue import Catalogue
from sequences.errors import InputError
from sequences.simulation import MotionConfig, PlaceConfig, SimulationConfig, TrajectoryConfig
from sequences.simulation.motion import arrange
from sequences.simulation.place import furnish
from tests.ctmap_gtsam import synthetic

PLACES = 10


@lru_cache(maxsize=2)
def simulated(together):
    """Classes, each place's one visit, and for each pair of movable things whether both stand on one spot."""
    config = SimulationConfig(
        place=PlaceConfig(objects=10, clutter=0, twins=0, together=together),
        motion=MotionConfig(visits=1),
        trajectory=TrajectoryConfig(frames=1),
    )
    classes, places, one_spot = {}, [], []
    for seed in range(PLACES):
        place = furnish(config.place, seed)
        (visit,) = arrange(place, config, seed)
        classes |= {s.object_class.obj_id: s.object_class for s in place.known.values()}
        things = visit.arrangements[-1].things
        there = (*things, *(f for f in visit.furniture if f.inst_id not in {t.inst_id for t in things}))
        places.append(
            {p.inst_id: Standing(place.known[p.inst_id].object_class.obj_id, p.T_world_object) for p in there}
        )
        for a, b in itertools.combinations([p for p in things if p.surface >= 0], 2):
            names = (place.known[p.inst_id].object_class.category for p in (a, b))
            one_spot.append((len(set(names)) == 1, spot_of(place, a) == spot_of(place, b)))
    return Catalogue(tuple(c for _, c in sorted(classes.items()))), places, np.array(one_spot)


def spot_of(place, placed):
    inside = np.linalg.inv(place.surfaces[placed.surface].T_world_area) @ placed.T_world_object
    x = inside[0, 3]
    spots = [k for k, s in enumerate(place.spots) if s.surface == placed.surface]
    return min(spots, key=lambda k: abs(x - (place.spots[k].low[0] + place.spots[k].high[0]) / 2))


def pairs_in(places, catalogue):
    return [pair for k, standing in enumerate(places) for pair in pairs_of(k, [standing], catalogue)]


def test_how_much_the_simulator_keeps_a_category_together_is_found():
    catalogue, places, one_spot = simulated(0.9)
    same, *_ = learn(pairs_in(places, catalogue), catalogue)
    kin, strangers = (one_spot[one_spot[:, 0] == flag, 1].mean() for flag in (True, False))
    # of the pairs on one spot, those that aren't there by chance
    drawn = (kin - strangers) / (1.0 - strangers)
    assert drawn > 0.3
    assert same.strength[0] <= drawn <= same.strength[1]
    assert same.related > 0.99
    assert same.relation.distance_m < 0.35  # a spot is half a metre long
    assert same.relation.sigma_m < 0.3


def test_what_the_simulator_spreads_anywhere_is_no_relation():
    catalogue, places, _ = simulated(0.0)
    same, *_ = learn(pairs_in(places, catalogue), catalogue)
    assert same.strength[0] == 0.0
    assert same.relation.strength < 0.1


@pytest.mark.parametrize("seed", [0, 1])
def test_shuffled_categories_teach_nothing(seed):
    catalogue, places, _ = simulated(0.9)
    true, *_ = learn(pairs_in(places, catalogue), catalogue)
    movable = [c for c in catalogue.classes if c.movable]
    order = np.random.default_rng(seed).permutation(len(movable))
    other = {c.obj_id: movable[k].category for c, k in zip(movable, order, strict=True)}
    shuffled = Catalogue(tuple(replace(c, category=other.get(c.obj_id, c.category)) for c in catalogue.classes))
    same, *_ = learn(pairs_in(places, shuffled), shuffled)
    assert same.strength[0] == 0.0
    assert same.relation.strength < 0.25 * true.relation.strength


# --- distances drawn from the model itself ---


def catalogue_of(*categories):
    """A class for each category given, called a, b, ..."""
    like = synthetic.catalogue().classes[0]
    return Catalogue(tuple(replace(like, obj_id=1 + k, name="abcdef"[k], category=c) for k, c in enumerate(categories)))


def drawn(rng, obj_ids, n, strength, m=0.0, s=0.25, area=16.0):
    """Pairs of Equation 5's category level: together with a probability, else anywhere on a disc."""
    anywhere = np.sqrt(rng.random(n) * area / np.pi)
    beside = np.abs(m + s * rng.standard_normal((8 * n, 2)))[:, 0]
    # the density of a distance in the plane grows with it
    beside = rng.choice(beside, n, p=beside / beside.sum())
    return [
        Pair(k % 9, obj_ids, float(d), 1.0) for k, d in enumerate(np.where(rng.random(n) < strength, beside, anywhere))
    ]


def test_the_interval_holds_the_strength_as_often_as_it_says():
    rng, n = np.random.default_rng(0), 25
    inside = 0
    for _ in range(n):
        pairs = drawn(rng, (1, 2), 60, 0.5, 0.3, 0.1) + drawn(rng, (1, 3), 300, 0.0)
        same, *_ = learn(pairs, catalogue_of("x", "x", "y"))
        inside += same.strength[0] <= 0.5 <= same.strength[1]
    assert inside / n >= 0.95 - 3.0 * np.sqrt(0.95 * 0.05 / n)


def test_many_pairs_give_all_parameters_and_the_area():
    rng = np.random.default_rng(1)
    pairs = drawn(rng, (1, 2), 1500, 0.6, 0.4, 0.11) + drawn(rng, (1, 3), 3000, 0.0)
    same, *others = learn(pairs, catalogue_of("x", "x", "y"))
    assert not others
    assert same.relation.strength == pytest.approx(0.6, abs=0.05)
    assert same.relation.distance_m == pytest.approx(0.4, abs=0.051)
    assert same.relation.sigma_m == pytest.approx(0.11, rel=0.35)
    assert same.relation.area_m2 == pytest.approx(16.0, rel=0.2)


def test_few_pairs_shrink_to_no_relation():
    rng = np.random.default_rng(2)
    strangers, kin = drawn(rng, (1, 3), 300, 0.0), drawn(rng, (1, 2), 100, 1.0, 0.2, 0.1)
    strengths = [
        learn(kin[:n] + strangers, catalogue_of("x", "x", "y"))[0].relation.strength for n in (1, 2, 4, 10, 100)
    ]
    assert strengths == sorted(strengths)
    assert strengths[0] < 0.4
    assert strengths[-1] > 0.9


def test_a_pair_of_classes_and_a_category_without_kin_have_relations_of_their_own():
    """A mouse beside its keyboard, of two categories; z's pairs stand anywhere, x's together."""
    rng = np.random.default_rng(3)
    catalogue = catalogue_of("x", "x", "y", "z", "z")
    pairs = drawn(rng, (1, 2), 150, 0.7, 0.2, 0.1) + drawn(rng, (4, 5), 150, 0.0)
    pairs += drawn(rng, (1, 3), 60, 0.9, 0.3, 0.1) + drawn(rng, (2, 3), 200, 0.0)
    pairs += [p for obj_ids in ((1, 4), (2, 4), (3, 5)) for p in drawn(rng, obj_ids, 150, 0.0)]
    learned = {one.names: one.relation for one in learn(pairs, catalogue)}
    assert learned["a", "c"].strength > 0.6
    assert ("b", "c") not in learned or learned["b", "c"].strength < 0.1
    assert learned["z", "z"].strength < 0.1
    assert ("x", "x") not in learned or learned["x", "x"].strength > 0.5


def test_strangers_have_the_mean_ratio_that_the_potential_promises():
    """Over pairs of other categories phi_cat / phi_background averages to 1, at any learned relation."""
    rng = np.random.default_rng(4)
    strangers = drawn(rng, (1, 3), 2000, 0.0)
    learned = learn(drawn(rng, (1, 2), 200, 0.5, 0.3, 0.1) + strangers, catalogue_of("x", "x", "y"))
    relations = replace(relations_of(learned), category_weight=1.0)
    table = relation_table(["a", "b"], ["x", "x"], relations)
    ratio = np.exp(context_log_ratio([p.distance_m for p in strangers], table[0, 1]))
    assert ratio.mean() == pytest.approx(1.0, abs=0.02)


def test_what_stands_still_is_one_pair_and_n_things_have_n_minus_1_positions():
    catalogue = catalogue_of("x", "x", "x", "y")
    at = {k: Standing(k, se3.make(np.eye(3), np.array([0.1 * k, 0.0, 0.0]))) for k in (1, 2, 3)}
    moved = at | {3: Standing(3, se3.make(np.eye(3), np.array([0.0, 1.0, 0.0])))}
    once = pairs_of(0, [at], catalogue)
    assert pairs_of(0, [at, at], catalogue) == once
    assert sum(p.weight for p in once) == pytest.approx(2.0)
    assert [p.obj_ids for p in pairs_of(0, [at, moved], catalogue)[3:]] == [(1, 3), (2, 3)]


def test_without_anything_to_compare_with_nothing_is_learned():
    with pytest.raises(InputError, match="category"):
        learn(drawn(np.random.default_rng(0), (1, 2), 50, 1.0, 0.1, 0.1), catalogue_of("x", "x"))


# --- runs on disk ---


def test_an_estimate_teaches_what_the_truth_does(tmp_path):
    run = load_run(synthetic.write_run(tmp_path / "run", frames=2, visits=2))
    truth = load_truth(run)
    true, found = standings_of_truth(run, truth), standings_of_estimate(synthetic.estimate_of(run, truth))
    for a, b in zip(true, found, strict=True):
        assert [s.obj_id for s in a.values()] == [s.obj_id for s in b.values()]
        np.testing.assert_allclose([s.T_world_object for s in a.values()], [s.T_world_object for s in b.values()])
    assert pairs_of(0, true, run.catalogue) == pytest.approx(pairs_of(0, found, run.catalogue))
    doubtful = synthetic.estimate_of(run, truth, existence=lambda n, f: 0.2)
    assert not any(standings_of_estimate(doubtful))


def ctmap(*arguments):
    return CliRunner().invoke(app, ["train", "context", *map(str, arguments)], prog_name="ctmap")


def test_what_is_learned_is_a_configuration(tmp_path):
    """Two kinds of things, in two places."""
    paths = [synthetic.write_run(tmp_path / name, frames=1) for name in ("a", "b")]
    for path in paths:
        file = path / "catalogue.json"
        file.write_text(file.read_text().replace('"category": "box"', '"category": "brick"', 1))
    done = ctmap(*paths, "--out", tmp_path / "context.toml")
    assert done.exit_code == 0, done.output
    config = load_config(tmp_path / "context.toml")
    assert config.context.relations != load_config().context.relations
    assert config.context.relations.category_weight == load_config().context.relations.category_weight
    assert "95 %" in (tmp_path / "context.toml").read_text()
    assert Model(synthetic.catalogue(), config).relations.together.shape == (3, 3)


def test_bad_input_is_named(tmp_path):
    path = synthetic.write_run(tmp_path / "run", frames=1)
    failed = ctmap(path, "--out", tmp_path / "context.toml")
    assert failed.exit_code == 2
    assert "category" in failed.stderr
    for file in path.rglob("scene_gt*.json"):
        file.unlink()
    failed = ctmap(path, "--out", tmp_path / "context.toml")
    assert failed.exit_code == 2
    assert "--estimate" in failed.stderr
    assert not (tmp_path / "context.toml").exists()
