import io

import pytest
from rich.console import Console

from ctmap_gtsam.runtime.progress import RichProgress
from sequences.progress import SILENT, Progress


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
