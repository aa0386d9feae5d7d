"""`compare_run`: what is in the folder, what is taken from it again, and that no kill leaves half a file."""

import hashlib
import json
import multiprocessing
import shutil
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ctmap_gtsam.comparing import compare_run, report, run_methods
from ctmap_gtsam.config import Config
from ctmap_gtsam.estimate import Estimate
from ctmap_gtsam.methods import Reading
from ctmap_gtsam.runtime.sources import code
from sequences.bop import load_run, load_truth
from sequences.errors import InputError
from sequences.progress import timed
from tests.ctmap_gtsam import synthetic


@dataclass(frozen=True)
class Fake:
    """A method that knows the truth, and counts how often it ran."""

    name: str
    kind: str = "estimate"
    metres: float = 0.0
    reason: str | None = None
    ran: Any = None
    needs: tuple[str, ...] = ()
    reads_truth: bool = False
    resumes: bool = False
    reading: Any = None

    def skip(self, run):
        return self.reason

    def run(self, run, config, progress, *needed, **kept):
        assert self.kind == "estimate"
        assert kept.keys() == ({"keep"} if self.resumes else set())
        if self.ran is not None and kept:
            self.ran.append(kept["keep"])
        assert [estimate.meta["method"] for estimate in needed] == list(self.needs)
        if self.ran is not None:
            self.ran.append(self.name)
        with progress.stage("work") as stage, timed(stage, "half of it"):
            pass
        meta = {"method": self.name, "seed": config.seed}
        return synthetic.estimate_of(run, load_truth(run), disturb=synthetic.shifted(self.metres), meta=meta)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return synthetic.write_run(tmp_path_factory.mktemp("run") / "small", frames=4)


@pytest.fixture
def ran():
    return []


@pytest.fixture
def registry(ran):
    methods = (
        Fake("detector", kind="detections"),
        Fake("icp", reason="Open3D can't be loaded"),
        Fake("filter-ct", metres=0.003, ran=ran),
        Fake("smooth-ct", ran=ran),
    )
    return {method.name: method for method in methods}


def summary_of(out: Path) -> dict:
    def refuse(name):
        raise AssertionError(f"{name} is not JSON")

    return json.loads((out / "summary.json").read_text(), parse_constant=refuse)


def test_the_folder_holds_everything(path, tmp_path, registry):
    comparison = compare_run(path, tmp_path, Config(seed=3), registry=registry)
    found = {p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*") if p.is_file()}
    assert found == {
        "summary.json",
        "report.html",
        "detector.json",
        *(f"{m}.{kind}" for m in ("filter-ct", "smooth-ct") for kind in ("csv", "json")),
        *(f"estimates/{m}.{kind}" for m in ("filter-ct", "smooth-ct") for kind in ("npz", "json")),
    }
    summary = summary_of(tmp_path)
    assert summary["schema"] == 1
    assert summary["seed"] == 3
    assert summary["versions"]["numpy"] == np.__version__
    methods = summary["methods"]
    assert list(methods) == ["detector", "icp", "filter-ct", "smooth-ct"]
    assert methods["icp"]["status"] == "skipped"
    assert "Open3D" in methods["icp"]["reason"]
    assert methods["filter-ct"]["status"] == "ok"
    assert methods["filter-ct"]["seconds"] > 0
    assert list(methods["filter-ct"]["stages"]) == ["work: half of it", "work"]
    assert methods["detector"]["stages"] == {}
    assert methods["filter-ct"]["metrics"]["mssd_mm_median"] == pytest.approx(3.0, abs=1e-6)
    assert methods["filter-ct"]["metrics"]["objects"]["clay_brick"]["mssd_mm_median"] == pytest.approx(3.0, abs=1e-6)
    assert methods["detector"]["metrics"]["mssd_mm_median"] is None
    assert methods["detector"]["metrics"]["class_accuracy"] == pytest.approx(2 / 3)
    assert comparison.methods["smooth-ct"].metrics["class_accuracy"] == 1
    for name, digest in summary["files"].items():
        assert hashlib.sha256((tmp_path / name).read_bytes()).hexdigest() == digest


def test_nothing_is_written_into_the_run(path, tmp_path, registry):
    before = {p: p.stat().st_mtime_ns for p in path.rglob("*")}
    compare_run(path, tmp_path, Config(), registry=registry)
    assert {p: p.stat().st_mtime_ns for p in path.rglob("*")} == before


def test_what_a_method_builds_on_runs_before_it_and_once(path, tmp_path, registry, ran):
    builds = Fake("builds", needs=("smooth-ct", "filter-ct"), ran=ran)
    registry = {"builds": builds, **registry}
    alone = run_methods(load_run(path), ["builds"], Config(), tmp_path, registry=registry)
    assert list(alone) == ["builds"]
    assert ran == ["smooth-ct", "filter-ct", "builds"]
    needed = run_methods(load_run(path), builds.needs, Config(), tmp_path, registry=registry)
    assert ran == ["smooth-ct", "filter-ct", "builds"]
    assert alone["builds"].seconds > sum(outcome.seconds for outcome in needed.values())
    inside = run_methods(load_run(path), None, Config(), registry=registry)
    assert ran[3:] == ["smooth-ct", "filter-ct", "builds"]
    inside["builds"].estimate.save(tmp_path / "inside.npz")
    assert (tmp_path / "inside.npz").read_bytes() == (tmp_path / "builds.npz").read_bytes()


def read_methods(path, made):
    """Two fakes that read off one pass, of which only one needs what it has kept."""

    def make(run, config, *, progress, keep_past):
        made.append(keep_past)
        with progress.stage("pass"):
            return keep_past

    def reading(name, keep_past):
        def read(run, state, progress):
            assert state or not keep_past
            return Fake(name).run(run, Config(), progress)

        return Reading(make, keep_past, read)

    return {name: Fake(name, reading=reading(name, past)) for name, past in (("on", False), ("back", True))}


@pytest.mark.parametrize(("methods", "kept"), [(["on"], False), (["back"], True), (None, True)])
def test_what_methods_read_their_estimates_off_is_made_once_and_keeps_what_one_of_them_needs(path, methods, kept):
    made = []
    outcomes = run_methods(load_run(path), methods, Config(), registry=read_methods(path, made))
    assert made == [kept]
    for outcome in outcomes.values():
        assert list(outcome.stages) == ["pass", "work: half of it", "work"]
        assert outcome.seconds > 0.0


def test_a_pass_keeps_nothing_for_an_estimate_that_is_there_already(path, tmp_path):
    made = []
    registry = read_methods(path, made)
    for methods in (["back"], None, None):
        run_methods(load_run(path), methods, Config(), tmp_path, registry=registry)
    assert made == [True, False]


def test_a_method_that_works_in_rounds_keeps_them_beside_the_estimates(path, tmp_path, ran):
    registry = {"slow": Fake("slow", resumes=True, ran=ran)}
    run = load_run(path)
    run_methods(run, ["slow"], Config(), registry=registry)
    run_methods(run, ["slow"], Config(), tmp_path, registry=registry)
    assert ran == [None, "slow", tmp_path / ".slow.rounds.npz", "slow"]


def test_a_method_that_reads_the_truth_is_marked_and_made_again_with_another_truth(path, tmp_path, ran):
    registry = {"icp-oracle": Fake("icp-oracle", reads_truth=True, ran=ran), "smooth-ct": Fake("smooth-ct", ran=ran)}
    run = tmp_path / "run"
    shutil.copytree(path, run)
    for _ in range(2):
        compare_run(run, tmp_path / "out", Config(), registry=registry)
    assert ran == ["icp-oracle", "smooth-ct"]
    summary = summary_of(tmp_path / "out")
    assert {name: told["reads_truth"] for name, told in summary["methods"].items()} == {
        "icp-oracle": True,
        "smooth-ct": False,
    }
    assert "icp-oracle reads the truth" in (tmp_path / "out" / "report.html").read_text()
    info = run / "test" / "000001" / "scene_gt_info.json"
    info.write_text(info.read_text() + "\n")
    compare_run(run, tmp_path / "out", Config(), registry=registry)
    assert ran == ["icp-oracle", "smooth-ct", "icp-oracle"]


def test_what_is_there_is_taken_again(path, tmp_path, registry, ran):
    compare_run(path, tmp_path, Config(), ["smooth-ct"], registry=registry)
    compare_run(path, tmp_path, Config(), registry=registry)
    assert ran == ["smooth-ct", "filter-ct"]
    first = summary_of(tmp_path)
    compare_run(path, tmp_path, Config(), registry=registry)
    assert ran == ["smooth-ct", "filter-ct"]
    assert summary_of(tmp_path) == first


@pytest.mark.parametrize("change", ["seed", "estimate", "about", "missing", "code"])
def test_what_differs_is_made_again(path, tmp_path, registry, ran, monkeypatch, change):
    run = load_run(path)
    run_methods(run, ["smooth-ct"], Config(), tmp_path, registry=registry)
    estimate, about = tmp_path / "smooth-ct.npz", tmp_path / "smooth-ct.json"
    whole = estimate.read_bytes()
    config = Config(seed=1) if change == "seed" else Config()
    if change == "estimate":
        estimate.write_bytes(whole[:500])
    elif change == "about":
        about.write_text("{")
    elif change == "missing":
        about.unlink()
    elif change == "code":
        monkeypatch.setattr("ctmap_gtsam.comparing.code", lambda: replace(code(), estimating="other"))
    outcome = run_methods(run, ["smooth-ct"], config, tmp_path, registry=registry)["smooth-ct"]
    assert ran == ["smooth-ct"] * 2
    if change != "seed":
        assert estimate.read_bytes() == whole
    assert Estimate.load(estimate).meta["seed"] == outcome.estimate.meta["seed"] == config.seed


def test_another_recording_is_another_estimate(path, tmp_path, registry, ran):
    other = synthetic.write_run(tmp_path / "other", frames=5)
    for run in (path, other):
        run_methods(load_run(run), ["smooth-ct"], Config(), tmp_path / "estimates", registry=registry)
    assert ran == ["smooth-ct"] * 2


def test_an_unknown_method_is_named_before_anything_runs(path, tmp_path, registry, ran):
    with pytest.raises(InputError, match="ctmap") as caught:
        compare_run(path, tmp_path / "out", Config(), ["smooth-ct", "ctmap"], registry=registry)
    assert "smooth-ct" in caught.value.remedy
    assert not ran
    assert not (tmp_path / "out").exists()


def test_a_bad_run_writes_nothing(tmp_path, registry):
    with pytest.raises(InputError):
        compare_run(tmp_path / "nowhere", tmp_path / "out", Config(), registry=registry)
    assert not (tmp_path / "out").exists()


def test_the_report_is_made_again_from_the_folder(path, tmp_path, registry):
    compare_run(path, tmp_path, Config(), registry=registry)
    page = (tmp_path / "report.html").read_text()
    (tmp_path / "report.html").unlink()
    assert report(tmp_path) == tmp_path / "report.html"
    assert (tmp_path / "report.html").read_text() == page


@pytest.mark.parametrize("damage", ["empty", "no json", "schema", "no estimate", "changed run"])
def test_a_folder_that_is_no_comparison_is_refused(path, tmp_path, registry, damage):
    if damage != "empty":
        compare_run(path, tmp_path, Config(), ["smooth-ct"], registry=registry)
    summary = tmp_path / "summary.json"
    if damage == "no json":
        summary.write_text("{")
    elif damage == "schema":
        summary.write_text("{}")
    elif damage == "no estimate":
        (tmp_path / "estimates" / "smooth-ct.npz").unlink()
    elif damage == "changed run":
        about = json.loads(summary.read_text())
        about["run"]["fingerprint"] = "other"
        summary.write_text(json.dumps(about))
    with pytest.raises(InputError) as caught:
        report(tmp_path)
    assert caught.value.file is not None
    assert caught.value.remedy


def check_whole(out: Path) -> None:
    for file in (p for p in out.rglob("*") if p.is_file() and not p.name.startswith(".")):
        if file.suffix == ".json":
            json.loads(file.read_text())
        elif file.suffix == ".npz":
            Estimate.load(file)
        elif file.suffix == ".csv":
            lines = file.read_text().splitlines()
            assert len(lines) == 1 + 3 * 4
            assert all(line.count(",") == 6 for line in lines)
        else:
            assert file.read_text().rstrip().endswith("</html>")


def test_a_kill_at_any_time_leaves_whole_files(path, tmp_path, registry):
    """Twenty kills over the time that one comparison takes, the last results lying there; then it goes on."""
    quick = {name: replace(method, ran=None) for name, method in registry.items() if name != "filter-ct"}
    compare_run(path, tmp_path, Config(), registry=quick)  # kernels are compiled
    start = time.perf_counter()
    compare_run(path, tmp_path, Config(seed=1), registry=quick)
    duration = time.perf_counter() - start
    context = multiprocessing.get_context("fork")
    for k in range(20):
        config = Config(seed=2 + k)
        process = context.Process(target=compare_run, args=(path, tmp_path, config), kwargs={"registry": quick})
        process.start()
        process.join(duration * (k + 0.5) / 20)
        process.kill()
        process.join()
        check_whole(tmp_path)
    compare_run(path, tmp_path, Config(), registry=quick)
    assert summary_of(tmp_path)["seed"] == 0
