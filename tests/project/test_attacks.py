"""A seeded hundred attacks: damaged configurations, command lines and files.

What is right is an answer or one `ValueError`, in commands one line and status 2; everything else has failed.
"""

import contextlib
import random
from pathlib import Path

import numpy as np
import pytest
from test_pages import commands

import ms_highway
from ms_highway.choice.values import load_values
from ms_highway.cli.main import main
from ms_highway.envs import ENVIRONMENTS
from ms_highway.game import learned_reward

HOSTILE = [None, True, -1, 0, 1e308, 10**400, float("nan"), float("inf"), "", "x" * 10**5, b"x", [], {}, [[]], object()]
HOSTILE += [np.array([]), np.array(np.nan), {"type": None}, {"type": "fixed"}, {1: 2}, [1e308, 1e308], [0.2, 1e-320]]
WORDS = "--grip=nan", "--control-limit=0,1e999", "--seed=-1", "--nonsense", "", "\0"
READERS = {"us101.json": learned_reward.load, "values.npz": load_values}


@pytest.fixture
def chance(request):
    """A source of randomness for each attack."""
    return random.Random(request.node.name)


@pytest.mark.parametrize("_", range(40))
def test_a_hostile_configuration_is_refused_or_survived(chance, _):
    environment = chance.choice(list(ENVIRONMENTS.values()))
    config = {chance.choice(list(environment.default_config())): chance.choice(HOSTILE)}
    with contextlib.suppress(ValueError):
        environment.checked_config(config)


@pytest.mark.parametrize("_", range(30))
def test_a_damaged_command_line_ends_in_one_line_and_writes_nothing(chance, _, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    line = chance.choice(commands()).partition(" > ")[0].split()[1:]
    word = chance.choice(WORDS)
    line.insert(len(line) if "=" in word else chance.randrange(1, len(line) + 1), word)
    try:
        status = main(line)
    except SystemExit as end:  # argparse, which shows the usage first
        status = end.code
    assert status == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith("ms-highway")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("_", range(30))
def test_a_damaged_file_is_refused_or_survived(chance, _, tmp_path):
    name = chance.choice(list(READERS))
    whole = (Path(ms_highway.__file__).parent / "data" / name).read_bytes()
    first, second = sorted(chance.randrange(len(whole)) for _ in range(2))
    noise = chance.randbytes(chance.randrange(1, 9))
    cut, changed, doubled = whole[:first], whole[:first] + noise + whole[first + 1 :], whole[:second] + whole[first:]
    (tmp_path / name).write_bytes(chance.choice([cut, changed, doubled]))
    with contextlib.suppress(ValueError):
        READERS[name](tmp_path / name)
