"""Notebooks run from top to bottom, and are committed with their outputs."""

import ast
import os
import re

import nbformat
import pytest
from episodes import drives_long
from nbclient import NotebookClient
from test_pages import NOTEBOOKS

QUICK = {
    "COIN_LAMBDAS": [0.01],
    "CONTROLLER": "naive",
    "CONTROLLERS": {"stay_back": "turn", "merger": "tom", "give_way": "turn"},
    "DEMONSTRATIONS": [2],
    "DENSITIES": ["sparse"],
    "EPISODES": 3,
    "FOLDS": 1,
    "HELD_OUT": 1,
    "HUMANS": 2,
    "LEARNED_LAMBDAS": [1],
    "MERGING_LAMBDAS": [0.001, 0.01, 0.1],
    "RECORDINGS": 1,
    "SEEDS": 1,
    "STEPS": 2,
    "TOM_STEPS": [6],
}
"""Values that replace the constants of cells that are tagged ``parameters``, so that a
notebook takes seconds.
"""

LARGEST = 3e6  # bytes
MACHINE = r"(?<![\w.])(/home/|/Users/|/root/|/tmp/|/work/|[A-Z]:\\\\)"
SKIPPED = "skipped: no data"


def texts(cell):
    """Return the text that a cell prints and shows."""
    return "".join(
        output.get("text", "") + output.get("data", {}).get("text/plain", "")
        for output in cell.outputs
    )


def kinds(cell):
    """Return the kinds of outputs that a cell shows besides text."""
    shown = [kind for output in cell.outputs for kind in output.get("data", {})]
    return [kind for kind in shown if kind in ("image/png", "text/html")]


@drives_long
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_that_runs_quickly_shows_the_committed_outputs(path, tmp_path):
    notebook, committed = (nbformat.read(path, as_version=4) for _ in range(2))
    (cell,) = (
        cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", [])
    )
    own = {
        target.id
        for statement in ast.parse(cell.source).body
        for target in statement.targets
    }
    quick = QUICK | {"RESULTS": str(tmp_path / "results")}
    assert own & {*quick}
    cell.source += "".join(f"\n{name} = {quick[name]!r}" for name in own & {*quick})
    client = NotebookClient(
        notebook, timeout=1200, resources={"metadata": {"path": str(path.parent)}}
    )
    places = dict.fromkeys(
        ("HOME", "IPYTHONDIR", "JUPYTER_RUNTIME_DIR", "XDG_RUNTIME_DIR"), str(tmp_path)
    )
    client.execute(env={**os.environ, **places})
    for cell, before in zip(notebook.cells, committed.cells, strict=True):
        if cell.cell_type == "code" and SKIPPED not in texts(cell):
            assert kinds(cell) == kinds(before)


def test_committed_notebooks_are_executed_small_and_without_local_paths():
    for path in NOTEBOOKS:
        assert path.stat().st_size < LARGEST, path
        notebook = nbformat.read(path, as_version=4)
        nbformat.validate(notebook)
        assert {*notebook.metadata} == {"kernelspec", "language_info"}, path
        cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
        for number, cell in enumerate(cells, 1):
            assert cell.execution_count == number, path
            assert not {"error", "stderr"} & {
                output.get("name", output.output_type) for output in cell.outputs
            }, path
            assert not re.search(f"{SKIPPED}|{MACHINE}", texts(cell)), texts(cell)
