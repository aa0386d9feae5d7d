import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner, Result

from ctmap_gtsam.bench import run_bench
from ctmap_gtsam.cli.app import app
from ctmap_gtsam.cli.show import show_solver
from ctmap_gtsam.config import Config, load_config
from ctmap_gtsam.estimate import Estimate
from sequences.errors import InputError
from tests.ctmap_gtsam.scenes import CHEAP
from tests.ctmap_gtsam.synthetic import write_run

COMMANDS = [
    ["demo"],
    ["simulate", "place"],
    ["inspect"],
    ["config"],
    ["filter"],
    ["smooth"],
    ["compare"],
    ["report"],
    ["train", "persistence"],
    ["train", "context"],
    ["train", "calibration"],
    ["bench", "render"],
    ["bench", "paper"],
    ["bench", "solver"],
]
HEAVY = ("cv2", "gtsam", "numba", "numpy", "open3d", "pandas", "pyrender", "scipy", "trimesh")


def ctmap(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(a) for a in arguments], prog_name="ctmap")


def assert_clean_error(result: Result, *words: str) -> None:
    assert result.exit_code == 2, result.output
    assert "Traceback" not in result.output
    for word in ("error: ", "remedy: ", *words):
        assert word in result.stderr
    assert not result.stdout


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_every_command_has_help_with_an_example(command: list[str]) -> None:
    result = ctmap(*command, "--help")
    assert result.exit_code == 0
    assert f"Example: ctmap {' '.join(command)}" in " ".join(result.stdout.split())


def test_these_are_all_the_commands() -> None:
    named = {command[0] for command in COMMANDS}
    assert {c.name or c.callback.__name__ for c in app.registered_commands if c.callback} | {
        g.name for g in app.registered_groups
    } == named


@pytest.mark.parametrize("statement", ["import ctmap_gtsam.cli.app", "import ctmap_gtsam; dir(ctmap_gtsam)"])
def test_nothing_heavy_is_imported_before_it_is_needed(statement: str) -> None:
    code = f"import sys\n{statement}\nprint([name for name in {HEAVY!r} if name in sys.modules])"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"


def test_config_prints_what_config_reads(tmp_path: Path) -> None:
    printed = ctmap("config", "--set", "keyframes.every=3", "--seed", "5")
    file = tmp_path / "settings.toml"
    file.write_text(printed.stdout)
    again = ctmap("config", "--config", file)
    assert (printed.exit_code, again.exit_code) == (0, 0)
    assert again.stdout == printed.stdout
    assert load_config(file) == load_config(assignments=["keyframes.every=3", "seed=5"])


@pytest.mark.parametrize(
    "arguments",
    [
        ["config"],
        ["simulate", "place", "{out}"],
        ["filter", "{run}", "--out", "{out}"],
        ["smooth", "{run}", "--out", "{out}"],
        ["compare", "{run}", "--out", "{out}"],
        ["demo", "--out", "{out}"],
        ["bench", "render"],
        ["bench", "paper", "--out", "{out}"],
    ],
    ids=" ".join,
)
def test_a_wrong_setting_is_one_clean_error_and_nothing_is_written(arguments: list[str], tmp_path: Path) -> None:
    out = tmp_path / "out"
    filled = [a.format(run=tmp_path, out=out) for a in arguments]
    assert_clean_error(ctmap(*filled, "--set", "keyframes.evry=2"), "field:  keyframes.evry", "keyframes.every?")
    assert_clean_error(ctmap(*filled, "--set", "keyframes.every=0"), "field:  keyframes.every", "at least 1")
    assert not out.exists()


@pytest.mark.parametrize("unfit", [("--no-context",), ("--graph", "graph")], ids=" ".join)
def test_a_fixed_lag_with_what_it_has_not_is_one_clean_error(unfit: tuple[str, ...], tmp_path: Path) -> None:
    result = ctmap("smooth", tmp_path, "--out", tmp_path / "out", "--lag", "2", *unfit)
    assert_clean_error(result, "field:  --lag", unfit[0])


@pytest.mark.parametrize("command", ["filter", "smooth", "compare"])
def test_a_run_that_is_none_is_one_clean_error(command: str, tmp_path: Path) -> None:
    assert_clean_error(ctmap(command, tmp_path / "nowhere", "--out", tmp_path / "out"), str(tmp_path / "nowhere"))


@pytest.mark.parametrize("command", ["filter", "smooth", "compare"])
def test_a_folder_that_cannot_be_written_is_one_clean_error(command: str, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("in the way")
    result = ctmap(command, tmp_path, "--out", file / "out")
    assert_clean_error(result, str(file / "out"))


def test_inspect_exits_with_2_and_names_every_problem(tmp_path: Path) -> None:
    result = ctmap("inspect", tmp_path / "nowhere", "--json", tmp_path / "problems.json")
    assert result.exit_code == 2
    problems = json.loads((tmp_path / "problems.json").read_text())["problems"]
    assert problems
    for problem in problems:
        assert problem["message"] in result.stdout
        assert problem["remedy"] in result.stdout


def test_an_unknown_measurement_names_those_there_are() -> None:
    with pytest.raises(InputError) as caught:
        run_bench("nothing", Config())
    assert "render" in caught.value.remedy


def test_a_measurement_prints_what_it_writes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    figures = {"a.per_s": 1.25, "b.per_s": None, "b.skipped": "a library is missing"}
    monkeypatch.setattr("ctmap_gtsam.bench.render.run", lambda *_: figures)
    result = ctmap("bench", "render", "--json", tmp_path / "render.json")
    assert result.stdout.splitlines() == ["a.per_s 1.25", "b.per_s None", "b.skipped a library is missing"]
    written = json.loads((tmp_path / "render.json").read_text())
    assert written["figures"] == figures
    assert written["seconds"] >= 0
    assert "numpy" in written["versions"]


def test_a_file_that_cannot_be_written_is_one_clean_error(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("in the way")
    result = ctmap("inspect", tmp_path / "nowhere", "--json", file / "problems.json")
    assert result.exit_code == 2
    assert "Traceback" not in result.output
    assert str(file) in result.stderr


def test_ctrl_c_says_how_to_go_on(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("sequences.validation.inspect_run", interrupted)
    result = ctmap("inspect", "a run")
    assert result.exit_code == 130
    assert "ctmap inspect 'a run'" in result.stderr
    assert "Traceback" not in result.output


@pytest.mark.parametrize(
    ("wrong", "word"),
    [(("--seeds", "some"), "reported"), (("--pass", "none"), "wrong-x4"), (("--methods", "none"), "filter-ct")],
)
def test_what_the_paper_has_not_is_one_clean_error(wrong: tuple[str, str], word: str, tmp_path: Path) -> None:
    assert_clean_error(ctmap("bench", "paper", "--out", tmp_path / "out", *wrong), word)
    assert not (tmp_path / "out").exists()


def test_smooth_shows_its_graph_and_says_where_it_hasnt_converged(tmp_path: Path) -> None:
    run, out = write_run(tmp_path / "run", frames=3), tmp_path / "out"
    cheap = [word for setting in (*CHEAP, "smoother.max_iterations=1") for word in ("--set", setting)]
    done = ctmap("smooth", run, "--out", out, "--graph", out / "graph", *cheap)
    assert done.exit_code == 0, done.output
    assert {path.name for path in (out / "graph").iterdir()} == {"factors.csv", "graph.dot", "graph.g2o", "graph.png"}
    told = Estimate.load(out / "smooth-ct.npz").meta["diagnostics"]
    lines = (out / "graph" / "factors.csv").read_text().splitlines()[1:]
    assert len(lines) == sum(told["factors"].values())
    errors = sum(float(line.split(",")[-1]) for line in lines)
    assert errors == pytest.approx(told["solver"]["trace"][-1], rel=1e-6)
    assert told["solver"]["end"] == "cap"
    assert "hasn't converged" in done.stderr
    assert "smoother.max_iterations = 1" in done.stderr


@pytest.mark.parametrize(("end", "words"), [("converged", ""), ("cap", "by 0.25 of 1.5 nats"), ("stalled", "stalled")])
def test_the_solvers_end_is_told_where_it_is_none(end: str, words: str, capsys: pytest.CaptureFixture[str]) -> None:
    estimate = SimpleNamespace(meta={"diagnostics": {"solver": {"end": end, "trace": [9.0, 1.75, 1.5]}}})
    show_solver(estimate, Config().smoother)
    told = capsys.readouterr()
    assert not told.out
    assert bool(told.err) == bool(words)
    assert words in told.err
