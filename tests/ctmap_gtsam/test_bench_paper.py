"""`ctmap bench paper`: what is done again, what isn't, and what the figures may depend on."""

import itertools
import json
import multiprocessing
import time
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctmap_gtsam.bench.paper import Task, Workshop, freeze, load_protocol, run_paper
from ctmap_gtsam.bench.paper.agenda import Agenda
from ctmap_gtsam.bench.paper.bootstrap import draws, interval, redrawn
from ctmap_gtsam.bench.paper.places import guard, identify, simulate
from ctmap_gtsam.bench.paper.plots import write_plots
from ctmap_gtsam.bench.paper.protocol import CEILING, MAIN, SETTINGS, Place, Variant
from ctmap_gtsam.bench.paper.units import Unit, seen_by
from ctmap_gtsam.config import Config, load_config
from ctmap_gtsam.methods import METHODS
from ctmap_gtsam.runtime.settings import to_dict
from sequences.bop import load_run, load_truth
from sequences.catalogue import Catalogue
from sequences.errors import InputError
from sequences.seeds import generator
from sequences.simulation import SimulationConfig
from tests.ctmap_gtsam import synthetic

PROTOCOL = load_protocol()
MAIN_PASS = PROTOCOL.variants[MAIN]


@dataclass(frozen=True)
class Fake:
    """A method that is wrong by up to `metres`, drawn from its seed and the run."""

    name: str
    metres: float = 0.0
    kind: str = "estimate"
    reason: str | None = None
    needs: tuple[str, ...] = ()
    reads_truth: bool = False

    def skip(self, run):
        return self.reason

    @property
    def run(self):
        return self.estimate if self.kind == "estimate" else None

    def estimate(self, run, config, progress, *needed):
        assert [one.meta["method"] for one in needed] == list(self.needs)
        rng = generator(config.seed, self.name, object_id=len(run.frames))
        disturb = synthetic.shifted(self.metres * rng.uniform())
        return synthetic.estimate_of(run, load_truth(run), disturb=disturb, meta={"method": self.name})


@dataclass(frozen=True)
class Broken(Fake):
    def estimate(self, run, config, progress, *needed):
        raise RuntimeError("nothing comes of this")


FAKES = {
    m.name: m
    for m in (
        Fake("detector", kind="detections"),
        Fake("copied", 0.01, needs=("filter-ct",)),
        Fake("filter-t", 0.02),
        Fake("filter-ct", 0.01),
    )
}
SEEDS = (0, 1)


def write_small(folder: Path, place: Place):
    """In the place of the simulator: quick, and a little different for each seed."""
    synthetic.write_run(folder, frames=2 + place.seed % 4)
    return identify(folder, place)


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr("ctmap_gtsam.bench.paper.units.simulate", write_small)
    monkeypatch.setattr("ctmap_gtsam.bench.paper.running.DRAWS", 5)
    monkeypatch.setattr("ctmap_gtsam.bench.paper.plots.write_plots", lambda folder, result: None)


OWN = load_config(SETTINGS)


def run(out, *, seeds=SEEDS, passes="main", registry=FAKES, config=OWN, **changes):
    shop = {"workers": 0, "say": lambda line: None, "manifest": out / "manifest.json"}
    task = Task(seeds, PROTOCOL.choose(passes), **{k: v for k, v in changes.items() if k in ("methods", "repeats")})
    shop |= {k: v for k, v in changes.items() if k not in ("methods", "repeats")}
    return run_paper(out, config, task, Workshop(registry=registry, **shop))


def without_seconds(value):
    if isinstance(value, dict):
        return {k: without_seconds(v) for k, v in value.items() if k != "seconds"}
    return [without_seconds(v) for v in value] if isinstance(value, list) else value


def times(out: Path) -> dict[str, int]:
    return {p.relative_to(out).as_posix(): p.stat().st_mtime_ns for p in (out / "units").rglob("*") if p.is_file()}


# --- resuming ---


def test_what_is_done_is_not_done_again(tmp_path):
    first = run(tmp_path)
    before = times(tmp_path)
    assert len(before) == 2 * (5 * 3 - 1)  # estimate, record and about each; no estimate for the detector
    assert without_seconds(run(tmp_path).result) == without_seconds(first.result)
    assert times(tmp_path) == before
    assert not (tmp_path / "places" / "000000" / "run").exists()


def test_kills_at_any_time_change_nothing(tmp_path):
    """Eight kills over the time that it takes, then it goes on to the same figures."""
    whole = run(tmp_path / "whole")
    began = time.perf_counter()
    run(tmp_path / "again")
    duration = time.perf_counter() - began
    for k in range(8):
        process = multiprocessing.get_context("fork").Process(target=run, args=(tmp_path / "killed",))
        process.start()
        process.join(duration * (k % 4 + 0.5) / 4)
        process.kill()
        process.join()
    resumed = run(tmp_path / "killed")
    assert without_seconds(resumed.result) == without_seconds(whole.result)


@pytest.mark.parametrize("damage", ["estimate", "record", "about", "settings", "judge"])
def test_what_is_damaged_or_of_something_else_is_done_again(tmp_path, damage, monkeypatch):
    whole = run(tmp_path, seeds=(0,))
    before = times(tmp_path)
    stem = tmp_path / "units" / "main" / "000000" / "filter-ct-0"
    config = OWN
    if damage == "settings":
        config = load_config(assignments=["sensor.kappa=0.06"])
    elif damage == "judge":
        from ctmap_gtsam.runtime import sources

        source = replace(sources.code(), judging="other")
        monkeypatch.setattr("ctmap_gtsam.bench.paper.running.Store", lambda *a: _store(*a, source=source))
    else:
        suffix = {"estimate": ".npz", "record": ".record.npz", "about": ".json"}[damage]
        (stem.parent / f"{stem.name}{suffix}").write_bytes(b"half")
    again = run(tmp_path, seeds=(0,), config=config)
    changed = {Path(name).name for name, t in times(tmp_path).items() if t != before[name]}
    own = {f"filter-ct-0{suffix}" for suffix in (".npz", ".record.npz", ".json")}
    if damage == "record":
        assert changed == own - {"filter-ct-0.npz"}
    elif damage == "about":
        assert changed == own
    elif damage == "judge":
        assert not any(name.endswith("-0.npz") for name in changed)
        assert len(changed) == 2 * 5
    elif damage == "settings":
        assert len(changed) == len(before)
    if damage != "settings":
        assert again.result["rows"] == without_or_with_seconds(whole.result["rows"], again.result["rows"])


def _store(*arguments, source):
    from ctmap_gtsam.bench.paper.units import Store

    return Store(*arguments, source=source)


def without_or_with_seconds(rows, other):
    return [{**row, "seconds": o["seconds"]} for row, o in zip(rows, other, strict=True)]


def test_a_unit_that_fails_fails_alone_and_is_tried_again(tmp_path):
    broken = {**FAKES, "filter-ct": Broken("filter-ct")}
    outcome = run(tmp_path, registry=broken)
    reasons = {f.job: f.reason for f in outcome.failures}
    assert set(reasons) == {f"{seed} {m}-0" for seed in SEEDS for m in ("filter-ct", "copied")}
    assert reasons["0 filter-ct-0"] == "RuntimeError: nothing comes of this"
    assert "Traceback" in outcome.failures[0].log.read_text()
    assert {row["method"] for row in outcome.result["rows"]} == set(FAKES) - {"filter-ct", "copied"} | {CEILING}
    assert "filter-ct-0 failed" in outcome.tables
    mended = run(tmp_path)
    assert not mended.failures
    assert without_seconds(mended.result) == without_seconds(run(tmp_path / "other").result)


def test_a_method_that_cannot_run_is_skipped_with_its_reason(tmp_path):
    outcome = run(tmp_path, registry={**FAKES, "icp": Fake("icp", reason="Open3D can't be loaded")})
    assert outcome.result["skipped"] == {"icp": "Open3D can't be loaded"}
    assert "Open3D can't be loaded" in outcome.tables


# --- figures ---


def test_figures_depend_on_no_order(tmp_path, monkeypatch):
    """Not on that of the units, and a method alone gives what it gives among others."""
    whole = run(tmp_path / "whole")

    class Backwards(Agenda):
        def __init__(self, store, units, registry, **rest):
            super().__init__(store, {p: units[p][::-1] for p in reversed(units)}, registry, **rest)

    monkeypatch.setattr("ctmap_gtsam.bench.paper.running.Agenda", Backwards)
    assert without_seconds(run(tmp_path / "back").result) == without_seconds(whole.result)
    for method in (*FAKES, CEILING):
        partly = run(tmp_path / "one by one", methods=(method,))
    assert without_seconds(partly.result) == without_seconds(whole.result)


def test_figures_depend_on_no_number_of_workers(tmp_path, monkeypatch):
    """With the simulator itself, in processes that nobody has told of any change made here."""
    monkeypatch.setattr("ctmap_gtsam.bench.paper.units.simulate", simulate)
    small = ["sensor.width=80", "sensor.antialias=1", "place.objects=1", "place.distractors=0", "motion.visits=1"]
    config = load_config(assignments=[f"simulation.{a}" for a in small])
    protocol = replace(PROTOCOL, keyframes=(2, 2), draws={})
    results = []
    for workers in (0, 2):
        out = tmp_path / str(workers)
        shop = Workshop(workers=workers, registry=FAKES, say=lambda line: None)
        task = Task((0, 1), (MAIN_PASS,), ("filter-t",), protocol=protocol)
        outcome = run_paper(out, config, task, shop)
        assert not outcome.failures
        results.append(without_seconds(outcome.result))
    assert results[0] == results[1]


def test_passes_add_to_what_is_there(tmp_path):
    run(tmp_path, methods=("detector", CEILING))
    outcome = run(tmp_path, passes="shuffled")
    rows = {(row["pass"], row["method"]) for row in outcome.result["rows"]}
    main = {"detector", CEILING, "filter-t"}
    assert rows == {(MAIN, m) for m in main} | {("shuffled", "filter-ct")}
    pairs = {(tuple(d["row"]), tuple(d["to"])) for d in outcome.result["differences"]}
    assert (("shuffled", "filter-ct"), (MAIN, "filter-t")) in pairs
    assert "## shuffled" in outcome.tables


def test_the_ceiling_closes_the_gap_and_the_detector_none_of_it(tmp_path):
    rows = {row["method"]: row for row in run(tmp_path).result["rows"]}
    assert rows[CEILING]["gap_closed"]["value"] == 1.0
    assert rows["detector"]["gap_closed"]["value"] == 0.0
    assert rows["detector"]["figures"]["map_50_paper"] < rows[CEILING]["figures"]["map_50_paper"]


def test_one_place_has_figures_and_no_intervals(tmp_path):
    result = run(tmp_path, seeds=(1,)).result
    for row in (*result["rows"], *result["differences"]):
        assert row["figures"]["map_50_paper"] is not None
        assert row["intervals"] == {}
    assert all(row["gap_closed"]["interval"] is None for row in result["rows"])


def test_repeats_are_other_draws_of_the_same_places(tmp_path):
    once, twice = run(tmp_path), run(tmp_path, repeats=2)
    a, b = ({r["method"]: r for r in o.result["rows"]} for o in (once, twice))
    assert a["filter-t"]["places"] == b["filter-t"]["places"] == len(SEEDS)
    assert a["filter-t"]["figures"] != b["filter-t"]["figures"]
    assert b[CEILING]["figures"]["map_50"] == a[CEILING]["figures"]["map_50"]


def test_other_settings_than_the_benchmark_s_own_are_told(tmp_path):
    assert run(tmp_path, seeds=(0,)).result["changed_settings"] == {}
    outcome = run(tmp_path, seeds=(0,), config=replace(OWN, sensor=replace(OWN.sensor, kappa=0.06)))
    assert outcome.result["changed_settings"] == {"sensor.kappa": 0.06}
    assert "not the benchmark's own: sensor.kappa=0.06" in outcome.tables


def test_pictures_and_tables_are_written(tmp_path):
    outcome = run(tmp_path, passes="main,shuffled")
    write_plots(tmp_path, outcome.result)
    assert (tmp_path / "paper.md").read_text() == outcome.tables
    assert json.loads((tmp_path / "paper.json").read_text()) == json.loads(json.dumps(outcome.result))
    for name in ("table-i", "places", "changes"):
        assert (tmp_path / f"{name}.png").stat().st_size > 5000
        assert (tmp_path / f"{name}.svg").read_text().startswith("<svg")
    assert "synthetic" in outcome.tables.splitlines()[0]
    assert "0.871" in outcome.tables


# --- bootstrap ---


@given(value=st.floats(-1e6, 1e6), places=st.integers(1, 20))
def test_what_is_the_same_everywhere_has_a_point_for_an_interval(value, places):
    drawn = redrawn(lambda items: {"x": float(np.mean(items))}, [(value,)] * places, draws(places, 50))
    assert interval(drawn["x"]) == pytest.approx((value, value))


def test_the_interval_of_a_mean_is_that_of_the_normal() -> None:
    rng = np.random.default_rng(1)
    values = rng.normal(size=400)
    drawn = redrawn(lambda items: {"x": float(np.mean(items))}, [(v,) for v in values], draws(400, 2000))
    half = 1.96 * values.std() / np.sqrt(400)
    assert interval(drawn["x"]) == pytest.approx((values.mean() - half, values.mean() + half), abs=0.1 * half)


def test_a_paired_difference_forgets_what_both_share() -> None:
    hard = np.random.default_rng(0).normal(size=20)
    drawn = draws(20, 500)
    a, b = (
        redrawn(lambda items: {"x": float(np.mean(items))}, [(h + gain,) for h in hard], drawn)["x"]
        for gain in (0.0, 0.1)
    )
    assert interval(b - a) == pytest.approx((0.1, 0.1))
    low, high = interval(a)
    assert high - low > 0.5


def test_draws_without_a_figure_leave_no_interval_where_they_are_many() -> None:
    assert interval(np.array([1.0] * 95 + [np.nan] * 5)) == (1.0, 1.0)
    assert interval(np.array([1.0] * 80 + [np.nan] * 20)) is None
    assert interval(np.full(3, np.nan)) is None


# --- the set ---


def test_places_keep_within_their_bounds_and_differ() -> None:
    places = [PROTOCOL.place(seed, OWN) for seed in (*PROTOCOL.sets["tuning"], *PROTOCOL.sets["reported"])]
    for place in places:
        motion, trajectory = place.simulation.motion, place.simulation.trajectory
        assert 60 <= motion.visits * trajectory.frames <= 100
        assert 8 <= place.simulation.place.objects <= 12
    assert len({json.dumps(to_dict(p.simulation)) for p in places}) == len(places)
    assert not set(PROTOCOL.sets["tuning"]) & set(PROTOCOL.sets["reported"])
    assert set(PROTOCOL.quick) < set(PROTOCOL.sets["tuning"])


def frozen(tmp_path, **changes):
    protocol = replace(PROTOCOL, sets={"tuning": (0, 1), "reported": (2, 3)})
    shop = Workshop(workers=0, registry=FAKES, manifest=tmp_path / "manifest.json", say=lambda line: None)
    return protocol, shop


def test_the_manifest_knows_its_places_and_no_others(tmp_path, monkeypatch):
    protocol, shop = frozen(tmp_path)
    task = Task((2, 3), (MAIN_PASS,), protocol=protocol)
    unfrozen = run_paper(tmp_path / "out", OWN, task, shop)
    assert unfrozen.result["frozen"] == {"holds": False, "complete": True, "reason": "no set has been frozen yet"}
    assert "not the frozen set" in unfrozen.tables
    assert not freeze(tmp_path / "out", OWN, protocol, shop)
    held = run_paper(tmp_path / "out", OWN, task, shop)
    assert held.result["frozen"] == {"holds": True, "complete": True, "reason": ""}
    assert "not" not in held.tables.split("|")[0]
    some = run_paper(tmp_path / "out", OWN, replace(task, seeds=(3,)), shop)
    assert some.result["frozen"]["holds"]
    assert "not all" in some.tables
    other = load_config(assignments=["simulation.sensor.depth_noise=2.0"])
    changed = run_paper(tmp_path / "changed", other, task, shop)
    assert "settings" in changed.result["frozen"]["reason"]
    assert run_paper(tmp_path / "out", OWN, replace(task, seeds=(0,)), shop).result["frozen"] is None


@pytest.mark.parametrize("name", ["rgb", "depth", "scene_detections.json", "scene_gt.json", "scene_camera_gt.json"])
def test_the_manifest_catches_a_changed_byte(tmp_path, name):
    protocol, shop = frozen(tmp_path)
    freeze(tmp_path / "out", OWN, protocol, shop)
    place = protocol.place(2, OWN)
    write_small(tmp_path / "run", place)
    assert guard({2: identify(tmp_path / "run", place)}, shop.manifest).holds
    scene = tmp_path / "run" / "test" / "000001"
    file = scene / name if name.endswith(".json") else sorted((scene / name).iterdir())[-1]
    data = bytearray(file.read_bytes())
    if name.endswith(".json"):
        data += b" "
    else:
        data[-1] ^= 1
    file.write_bytes(data)
    what = guard({2: identify(tmp_path / "run", place)}, shop.manifest)
    assert not what.holds
    assert what.differing == {2: "truth" if "gt" in name else "run"}


def test_a_set_is_not_frozen_where_a_place_fails(tmp_path, monkeypatch):
    def fails(folder, place):
        raise InputError("things don't fit")

    monkeypatch.setattr("ctmap_gtsam.bench.paper.units.simulate", fails)
    protocol, shop = frozen(tmp_path)
    assert len(freeze(tmp_path / "out", OWN, protocol, shop)) == 2
    assert not shop.manifest.exists()


# --- passes ---


def small_unit(variant: Variant, seed: int) -> Unit:
    return Unit(variant, Place(seed, SimulationConfig()), "filter-ct", 0)


@pytest.fixture(scope="module")
def small_run(tmp_path_factory):
    loaded = load_run(synthetic.write_run(tmp_path_factory.mktemp("run") / "small", frames=1))
    kinds = itertools.cycle(("food", "bath", "desk"))
    many = [
        replace(c, category=next(kinds), obj_id=9 * k + c.obj_id) for k in range(4) for c in loaded.catalogue.classes
    ]
    return replace(loaded, catalogue=Catalogue(tuple(many)))


def test_shuffled_categories_are_a_permutation_drawn_from_the_place(small_run):
    shuffled = [seen_by(small_run, small_unit(PROTOCOL.variants["shuffled"], seed)).catalogue for seed in range(5)]
    before = [c.category for c in small_run.catalogue.classes]
    for catalogue in shuffled:
        assert Counter(c.category for c in catalogue.classes) == Counter(before)
        same = [
            replace(c, category=o.category) for c, o in zip(catalogue.classes, small_run.catalogue.classes, strict=True)
        ]
        for c, o in zip(same, small_run.catalogue.classes, strict=True):
            assert (c.obj_id, c.name, c.persistence_s, c.mesh) == (o.obj_id, o.name, o.persistence_s, o.mesh)
    assert len({tuple(c.category for c in catalogue.classes) for catalogue in (*shuffled, small_run.catalogue)}) == 6
    again = seen_by(small_run, small_unit(PROTOCOL.variants["shuffled"], 3)).catalogue
    assert [c.category for c in again.classes] == [c.category for c in shuffled[3].classes]


@pytest.mark.parametrize(("name", "factor"), [("wrong-x4", 4.0), ("wrong-/4", 0.25)])
def test_wrong_passes_are_wrong_by_four(small_run, name, factor):
    variant, before = PROTOCOL.variants[name], Config()
    after = variant.settings(before)
    assert after.prediction.rotation_rate**2 == pytest.approx(factor * before.prediction.rotation_rate**2)
    assert after.prediction.translation_rate**2 == pytest.approx(factor * before.prediction.translation_rate**2)
    assert after.sensor.sigma_m == pytest.approx(factor * before.sensor.sigma_m)
    assert after.sensor.sigma_quadratic_per_m == pytest.approx(factor * before.sensor.sigma_quadratic_per_m)
    changed = seen_by(small_run, small_unit(variant, 0)).catalogue
    for a, b in zip(changed.classes, small_run.catalogue.classes, strict=True):
        assert a.persistence_s == factor * b.persistence_s
        assert a.category == b.category


def test_the_main_pass_changes_nothing(small_run):
    assert MAIN_PASS.settings(Config()) == Config()
    after = seen_by(small_run, small_unit(MAIN_PASS, 0))
    assert after.catalogue.classes == small_run.catalogue.classes


@pytest.mark.parametrize("variant", [v for v in PROTOCOL.variants.values() if v.kind != "main"], ids=lambda v: v.name)
def test_every_pass_changes_what_it_says_and_never_the_data(variant):
    config = load_config(SETTINGS)
    after = variant.settings(config)
    assert after.simulation == config.simulation
    assert after != config or variant.shuffled
    assert set(variant.methods) | set(variant.main) <= set(METHODS)
    assert variant.summary


@pytest.mark.parametrize(
    ("ask", "there"),
    [
        (lambda out: PROTOCOL.seeds("three"), "reported"),
        (lambda out: PROTOCOL.seeds("1,1"), "reported"),
        (lambda out: PROTOCOL.choose("main,wrong"), "wrong-x4"),
        (lambda out: run(out, methods=("filter",)), "filter-ct"),
    ],
)
def test_what_does_not_exist_is_named_with_what_does(ask, there, tmp_path):
    with pytest.raises(InputError) as caught:
        ask(tmp_path)
    assert there in caught.value.remedy
    assert not (tmp_path / "units").exists()


def test_lists_of_seeds_and_passes() -> None:
    assert PROTOCOL.seeds("0-2,7") == (0, 1, 2, 7)
    assert PROTOCOL.seeds("quick") == PROTOCOL.quick
    assert [v.name for v in PROTOCOL.choose("passes")] == ["wrong-x4", "wrong-/4", "shuffled"]
    assert all(v.kind == "ablation" for v in PROTOCOL.choose("ablations"))
    assert PROTOCOL.set_of((100, 101)) == "reported"
    assert PROTOCOL.set_of((0, 100)) is None
