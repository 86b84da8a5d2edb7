"""Any damage of a file that is read gives one error, which names the file."""

from importlib import resources

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as draw
from recordings import scenario

from ms_highway.choice.learned_value import load_values
from ms_highway.data.learned_reward import load, save, shipped
from ms_highway.experiments.directory import ResultsDirectory, this_run
from ms_highway.experiments.learning import read_rollouts
from ms_highway.experiments.validation import read_reference
from ms_highway.recorded.commonroad import read_scenario
from ms_highway.runtime.files import write_json


def write_values(path):
    values = resources.files("ms_highway") / "data" / "values.npz"
    path.write_bytes(values.read_bytes())


def write_reward(path):
    save(shipped("us101"), path)


def write_logs(path):
    steps = np.zeros((1, 2), int)
    np.savez(
        path,
        states=np.zeros((1, 2, 3, 4)),
        robot_controls=np.zeros((1, 2, 2)),
        human_controls=np.zeros((1, 1, 2)),
        rewards=np.zeros((1, 2)),
        models=steps,
        ladder=np.arange(3),
    )


def write_rollouts(path):
    np.savez(path, descriptions=np.zeros((3, 5)), gains=np.zeros((3, 2)))


def write_scenario(path):
    path.write_text(scenario())


def write_settings(path):
    write_json(path, {"seeds": [0, 1], "controllers": ["tom", "turn"]})


def write_runs(path):
    write_json(path, [this_run("ms-highway sweep")])


KINDS = {
    "values.npz": (write_values, load_values),
    "reward.json": (write_reward, load),
    "merger__tom.npz": (write_logs, read_reference),
    "rollouts.npz": (write_rollouts, read_rollouts),
    "scenario.xml": (write_scenario, read_scenario),
    "settings.json": (
        write_settings,
        lambda path: ResultsDirectory(path.parent).settings(),
    ),
    "provenance.json": (
        write_runs,
        lambda path: ResultsDirectory(path.parent).runs(),
    ),
}


@pytest.fixture(scope="module", params=KINDS)
def kind(request, tmp_path_factory):
    """Return the path of a kind of file, its content, and what reads it."""
    path = tmp_path_factory.mktemp("damaged") / request.param
    write, read = KINDS[request.param]
    write(path)
    read(path)
    return path, path.read_bytes(), read


def told(read, path):
    """Return what a refusal of a file says; None if it is read."""
    try:
        read(path)
    except ValueError as error:
        return str(error)
    return None


@given(place=draw.floats(0.0, 1.0, exclude_max=True), change=draw.integers(0, 255))
def test_a_damaged_file_is_read_or_refused_by_its_name(kind, place, change):
    """A byte is changed or, where the change is 0, missing."""
    path, content, read = kind
    damaged = bytearray(content)
    number = int(place * len(content))
    if change:
        damaged[number] ^= change
    else:
        del damaged[number]
    path.write_bytes(damaged)
    assert told(read, path) is None or path.name in told(read, path)


@given(share=draw.floats(0.0, 1.0, exclude_max=True))
def test_a_truncated_file_is_read_or_named(kind, share):
    path, content, read = kind
    path.write_bytes(content[: int(share * len(content))])
    assert told(read, path) is None or path.name in told(read, path)
