"""The attacks that are counted by hand, so that the script stays one that runs."""

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
def test_nothing_that_is_attacked_fails():
    script = Path(__file__).parents[1] / "attacks.py"
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert [line.split()[-4] for line in done.stdout.splitlines()] == ["0"] * 4
