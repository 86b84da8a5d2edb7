"""Commands as a user types them, and Python in other processes."""

import subprocess
import sys
from typing import Any

from ms_highway.cli.main import main


def run(command: str) -> None:
    """Run a command of words with a single space between them, which has to succeed."""
    assert main(command.split(" ")) == 0


def python(
    *words: str, status: int = 0, **options: Any
) -> subprocess.CompletedProcess[str]:
    """Run Python in another process, assert its exit status, and return its output."""
    done = subprocess.run(
        [sys.executable, *words], capture_output=True, text=True, **options
    )
    assert done.returncode == status, done.stdout + done.stderr
    return done
