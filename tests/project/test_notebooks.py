"""Notebooks run from top to bottom, and are committed as they come out."""

import ast
import os
import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient
from nbformat import NotebookNode

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


@pytest.fixture(params=NOTEBOOKS, ids=lambda path: path.stem)
def committed(request) -> NotebookNode:
    notebook = nbformat.read(request.param, as_version=4)
    nbformat.validate(notebook)
    return notebook


def parameters(notebook):
    (cell,) = (cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", []))
    return cell


def quickened(notebook, results):
    """The notebook with quick constants, set after its own, and a directory for results where it asks for one."""
    quick = nbformat.from_dict(notebook)
    cell = parameters(quick)
    own = {target.id for statement in ast.parse(cell.source).body for target in statement.targets}
    changes = {name: value for name, value in {**QUICK, "RESULTS": str(results)}.items() if name in own}
    assert changes, f"none of {sorted(own)} has a quick value in QUICK"
    cell.source += "".join(f"\n{name} = {value!r}" for name, value in changes.items())
    return quick


def kinds(cell):
    """What a cell shows besides text: pictures, videos and tables, in order."""
    found = []
    for output in cell.get("outputs", []):
        data = output.get("data", {})
        if "image/png" in data:
            found.append("picture")
        elif "text/html" in data:
            found.append("video" if "<video" in data["text/html"] else "table")
    return found


def said(cell):
    return "".join(output.get("text", "") for output in cell.get("outputs", []))


def code(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


@pytest.mark.slow
def test_a_notebook_runs_and_shows_what_the_committed_one_shows(committed, tmp_path):
    quick = quickened(committed, tmp_path / "results")
    client = NotebookClient(quick, timeout=1200, resources={"metadata": {"path": str(NOTEBOOKS[0].parent)}})
    places = dict.fromkeys(("HOME", "IPYTHONDIR", "JUPYTER_RUNTIME_DIR", "XDG_RUNTIME_DIR"), str(tmp_path))
    client.execute(env={**os.environ, **places})
    for cell, before in zip(code(quick), code(committed), strict=True):
        if SKIPPED not in said(cell):
            assert kinds(cell) == kinds(before)
    assert sum(map(len, map(kinds, code(quick)))) > 3


def test_a_notebook_is_committed_executed_and_small_and_tells_nothing_of_the_machine(committed, request):
    path = request.node.callspec.params["committed"]
    assert path.stat().st_size < LARGEST
    assert [cell.execution_count for cell in code(committed)] == list(range(1, len(code(committed)) + 1))
    assert set(committed.metadata) == {"kernelspec", "language_info"}
    for cell in committed.cells:
        assert SKIPPED not in said(cell)
        for output in cell.get("outputs", []):
            assert output.output_type != "error"
            assert output.get("name") != "stderr"
            text = said({"outputs": [output]}) + "".join(
                value
                for kind, value in output.get("data", {}).items()
                if kind.startswith("text") and "base64" not in value
            )
            assert not MACHINE.search(text), text


def test_there_are_notebooks_of_scenarios_human_switching_and_stock_roads():
    assert [path.stem for path in NOTEBOOKS] == ["01_scenarios", "02_human", "03_fixed_vs_switching", "04_road"]
