"""Notebooks run from top to bottom, and are committed as they come out."""

import ast
import os
import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).parents[2] / "notebooks").glob("*.ipynb"))
QUICK = {
    "COIN_LAMBDAS": [0.01],
    "CONTROLLER": "naive",
    "CONTROLLERS": {"stay_back": "turn", "merger": "tom", "give_way": "turn"},
    "DEMONSTRATIONS": [2],
    "DENSITIES": ["sparse"],
    "DRIVER": "mpc",
    "EPISODES": 3,
    "FOLDS": 1,
    "HELD_OUT": 1,
    "HUMANS": 2,
    "MERGING_LAMBDAS": [0.001, 0.01, 0.1],
    "PASSING_LAMBDAS": [0.4, 5],
    "RECORDINGS": 1,
    "SEEDS": 1,
    "STEPS": 2,
    "TOM_STEPS": [6],
    "TURN_STEPS": [12],
}
"""What takes the place of constants in cells that are tagged ``parameters``, so that a notebook takes seconds."""

LARGEST = 3e6  # bytes
MACHINE = re.compile(r"(?<![\w.])(/home/|/Users/|/root/|/tmp/|/work/|[A-Z]:\\\\)")
SKIPPED = "skipped: no data"


def code(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def texts(cell):
    """What a cell prints and shows, but for pictures."""
    printed = [output.get("text", "") for output in cell.outputs]
    shown = [data for output in cell.outputs for kind, data in output.get("data", {}).items() if "text" in kind]
    return "".join(printed + [data for data in shown if "base64" not in data])


def kinds(cell):
    """What a cell shows besides text: pictures, videos and tables, in order."""
    shown = [output.get("data", {}) for output in cell.outputs]
    return [
        "picture" if "image/png" in data else "video" if "<video" in data["text/html"] else "table"
        for data in shown
        if {"image/png", "text/html"} & {*data}
    ]


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_with_quick_constants_and_shows_what_the_committed_one_shows(path, tmp_path):
    notebook, committed = (nbformat.read(path, as_version=4) for _ in range(2))
    (cell,) = (cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", []))
    own = {target.id for statement in ast.parse(cell.source).body for target in statement.targets}
    quick = QUICK | {"RESULTS": str(tmp_path / "results")}
    assert own & {*quick}
    cell.source += "".join(f"\n{name} = {value!r}" for name, value in quick.items() if name in own)
    client = NotebookClient(notebook, timeout=1200, resources={"metadata": {"path": str(path.parent)}})
    places = dict.fromkeys(("HOME", "IPYTHONDIR", "JUPYTER_RUNTIME_DIR", "XDG_RUNTIME_DIR"), str(tmp_path))
    client.execute(env={**os.environ, **places})
    for cell, before in zip(code(notebook), code(committed), strict=True):
        assert SKIPPED in texts(cell) or kinds(cell) == kinds(before)
    assert sum(map(len, map(kinds, code(notebook)))) > 3


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_committed_executed_and_small_and_says_nothing_of_the_machine(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert path.stat().st_size < LARGEST
    assert [cell.execution_count for cell in code(notebook)] == list(range(1, len(code(notebook)) + 1))
    assert set(notebook.metadata) == {"kernelspec", "language_info"}
    for cell in code(notebook):
        assert not any(output.output_type == "error" or output.get("name") == "stderr" for output in cell.outputs)
        assert SKIPPED not in texts(cell)
        assert not MACHINE.search(texts(cell)), texts(cell)
