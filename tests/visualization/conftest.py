"""A comparison that pages and tables are made of."""

import pytest
from comparisons import COMPARE

from ms_highway.cli.main import main


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """A comparison of which one episode was run first, and the rest later."""
    directory = tmp_path_factory.mktemp("compare")
    for seeds in ("1", "2"):
        assert main([*COMPARE, str(directory), "--seeds", seeds]) == 0
    return directory
