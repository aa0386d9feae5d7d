from pathlib import Path

import pytest

from tests.tiny import write_tiny_run


@pytest.fixture(scope="session")
def tiny_run_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny run that nobody changes."""
    run = tmp_path_factory.mktemp("tiny") / "run"
    write_tiny_run(run)
    return run


@pytest.fixture
def tiny_run(tmp_path: Path) -> Path:
    """A tiny run to break."""
    run = tmp_path / "run"
    write_tiny_run(run)
    return run
