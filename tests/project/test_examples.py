"""The examples beside the notebooks run."""

import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "notebooks" / "examples"


def test_an_agent_learns_to_choose_and_is_told_beside_switching_and_tom():
    pytest.importorskip("stable_baselines3", reason='needs the extra learning: pip install -e ".[learning]"')
    command = [sys.executable, str(EXAMPLES / "learn_to_choose.py"), "merger", "--steps", "450", "--episodes", "1"]
    run = subprocess.run(command, check=True, capture_output=True, text=True)
    title, _, *rows = run.stdout.splitlines()
    assert title == "merger, 1 episodes, a second of planning costs 3"
    table = {row[:16].strip(): [float(cell) for cell in row[16:].split()] for row in rows}
    assert list(table) == ["switching:0.1", "tom", "dqn, seed 0"]
    assert table["tom"][1] == 370
    for reward, milliseconds, net in table.values():
        assert 90 <= milliseconds <= 370
        assert net == pytest.approx(reward - 3 * milliseconds / 1e3, abs=0.02)
