"""Execute the notebooks in place, so that what is committed shows what the code does now.

Example: `.venv/bin/python tools/execute_notebooks.py`
"""

from __future__ import annotations

import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parents[1]
KERNEL = {"display_name": "Python 3", "language": "python", "name": "python3"}
SECONDS = 900  # for one cell, on a slow machine


def execute(path: Path) -> nbformat.NotebookNode:
    """The notebook with fresh outputs, without metadata that differ from machine to machine.

    Raises:
        nbclient.exceptions.CellExecutionError: a cell failed.
    """
    notebook = nbformat.read(path, as_version=4)
    resources = {"metadata": {"path": str(path.parent)}}
    client = NotebookClient(notebook, timeout=SECONDS, kernel_name="python3", record_timing=False, resources=resources)
    client.execute()
    notebook.metadata = nbformat.from_dict({"kernelspec": KERNEL, "language_info": {"name": "python"}})
    return notebook


if __name__ == "__main__":
    from ctmap_gtsam.runtime.threads import limit_library_threads

    limit_library_threads()  # the kernel gets it from here: a sum split over threads depends on their number
    for path in [Path(name) for name in sys.argv[1:]] or sorted(ROOT.glob("notebooks/*.ipynb")):
        executed = execute(path)
        path.write_text(nbformat.writes(executed) + "\n", encoding="utf-8")
        print(path)
