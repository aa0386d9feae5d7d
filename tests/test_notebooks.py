"""The notebooks run as they are, and what is committed of them is what a run gives."""

import re
from collections.abc import Iterator
from pathlib import Path

import nbformat
import pytest

from tools.execute_notebooks import execute

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted(ROOT.glob("notebooks/*.ipynb"))
LARGEST = 1_500_000  # bytes
MACHINE = re.compile(r"/(?:home|root|tmp|work|usr|var|private|Users)/|[A-Z]:\\|site-packages|\.venv|\b0x[0-9a-f]{6,}")


def code_cells(notebook: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def words(cell: nbformat.NotebookNode) -> Iterator[str]:
    """All text in a cell's outputs."""
    for output in cell.outputs:
        yield output.get("text", "")
        yield from (data for kind, data in output.get("data", {}).items() if not kind.startswith("image/"))


def kinds(cell: nbformat.NotebookNode) -> list[tuple[str, tuple[str, ...]]]:
    """What a cell shows: prints, tables, pictures; not what is in them."""
    return [(output.output_type, tuple(sorted(output.get("data", {})))) for output in cell.outputs]


@pytest.fixture(params=NOTEBOOKS, ids=lambda path: path.stem)
def path(request: pytest.FixtureRequest) -> Path:
    return request.param


def test_there_is_one() -> None:
    assert NOTEBOOKS


def test_the_committed_one_was_executed_from_top_to_bottom(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    cells = code_cells(notebook)
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert all(cell.outputs for cell in cells if "plt.show()" in cell.source or "show(figure)" in cell.source)
    shown = {kind for cell in cells for _, data in kinds(cell) for kind in data}
    assert {"image/png", "text/html"} <= shown


def test_the_committed_one_says_nothing_of_the_machine_and_is_small(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    outputs = [output for cell in code_cells(notebook) for output in cell.outputs]
    assert [o for o in outputs if o.output_type == "error" or o.get("name") == "stderr"] == []
    assert [text for cell in code_cells(notebook) for text in words(cell) if MACHINE.search(text)] == []
    assert notebook.metadata.kernelspec.name == "python3"
    assert [cell.metadata for cell in notebook.cells if cell.metadata] == []
    assert path.stat().st_size < LARGEST


def test_links_lead_somewhere(path: Path) -> None:
    texts = [cell.source for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "markdown"]
    links = [link for text in texts for link in re.findall(r"\]\(([^)#]+)", text) if "://" not in link]
    assert [link for link in links if not (path.parent / link).exists()] == []


def test_it_runs_afresh_and_shows_what_the_committed_one_shows(path: Path) -> None:
    committed, fresh = nbformat.read(path, as_version=4), execute(path)
    for before, after in zip(code_cells(committed), code_cells(fresh), strict=True):
        assert kinds(after) == kinds(before), after.source
        assert not any(output.get("name") == "stderr" for output in after.outputs), after.source
