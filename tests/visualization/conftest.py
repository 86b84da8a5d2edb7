"""A comparison that pages and tables are made of."""

import pytest
from commands import run
from comparisons import COMPARE


@pytest.fixture(scope="session")
def compared(tmp_path_factory):
    """A comparison of which one episode was run first, and the rest later."""
    directory = tmp_path_factory.mktemp("compare")
    for seeds in (1, 2):
        run(f"{COMPARE} {directory} --seeds {seeds}")
    return directory
