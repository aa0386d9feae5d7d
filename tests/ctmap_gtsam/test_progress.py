import io

import pytest
from rich.console import Console

from ctmap_gtsam.runtime.progress import RichProgress, Stopwatch
from sequences.progress import SILENT, Progress, timed


def log_of(console: Console) -> list[str]:
    assert isinstance(console.file, io.StringIO)
    return [line.rsplit("  ", 1)[0] for line in console.file.getvalue().splitlines()]


def plain() -> Console:
    return Console(file=io.StringIO(), width=80)


def work(progress: Progress) -> None:
    with progress.stage("outer", total=2) as outer:
        with progress.stage("[inner]") as inner:
            inner.advance(3)
        outer.advance()


def test_without_a_terminal_each_stage_is_one_line_when_it_ends() -> None:
    console = plain()
    with RichProgress(console) as progress:
        work(progress)
    assert log_of(console) == ["  [inner]", "outer"]


def test_a_stage_that_fails_is_not_said_to_be_done() -> None:
    console = plain()
    with RichProgress(console) as progress:
        with pytest.raises(ValueError, match="bad"), progress.stage("fails"):
            raise ValueError("bad")
        work(progress)
    assert log_of(console) == ["  [inner]", "outer"]


def test_nothing_goes_to_stdout(capsys: pytest.CaptureFixture[str]) -> None:
    with RichProgress() as progress:
        work(progress)
    work(SILENT)
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "outer" in captured.err


def test_a_terminal_shows_how_far_each_stage_is() -> None:
    console = Console(file=io.StringIO(), width=80, force_terminal=True)
    with RichProgress(console) as progress, progress.stage("frames", total=7) as stage:
        stage.advance(4)
        progress._bars.refresh()
    assert isinstance(console.file, io.StringIO)
    assert "4/7" in console.file.getvalue()


def test_a_stopwatch_keeps_stages_and_their_parts_and_hands_all_on() -> None:
    console = plain()
    with RichProgress(console) as progress:
        watch = Stopwatch(progress)
        for _ in range(2):
            with watch.stage("filter") as stage:
                stage.spent("images", 2.0)
                stage.spent("objects", 1.5)
                stage.advance()
        work(watch)
    assert watch.seconds["filter: images"] == 4.0
    assert watch.seconds["filter: objects"] == 3.0
    assert watch.seconds.keys() == {"filter: images", "filter: objects", "filter", "[inner]", "outer"}
    assert watch.seconds["outer"] >= watch.seconds["[inner]"] >= 0.0
    assert isinstance(console.file, io.StringIO)
    assert console.file.getvalue().count("(images 2.0, objects 1.5)") == 2


def test_what_fails_has_taken_its_time_too() -> None:
    watch = Stopwatch(SILENT)
    with watch.stage("outer") as stage, pytest.raises(ValueError, match="bad"), timed(stage, "part"):
        raise ValueError("bad")
    assert watch.seconds["outer"] >= watch.seconds["outer: part"] >= 0.0
