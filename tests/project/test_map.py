"""The map is short, and everything that it names exists."""

import re
import tomllib
from operator import attrgetter

from pages import MAP, ROOT

import ms_highway

TEXT = MAP.read_text()
PACKAGE = ROOT / "ms_highway"


def test_the_map_is_short():
    assert len(TEXT.splitlines()) <= 60


def test_the_map_lists_all_packages_in_the_order_of_their_imports():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())
    (contract,) = settings["tool"]["importlinter"]["contracts"]
    layers = [layer for layer in contract["layers"] if layer != "__main__"]
    assert re.findall(r"^\| `(\w+)`", TEXT, re.MULTILINE) == layers
    assert sorted(layers) == sorted(path.parent.name for path in PACKAGE.glob("*/__init__.py"))


def test_every_file_and_directory_that_the_map_names_exists():
    places = re.findall(r"`([\w/]+(?:\.py|/))`|`(tests/\w+)`", TEXT)
    assert len(places) > 30
    for place in {name or test for name, test in places}:
        assert (PACKAGE / place).exists() or (ROOT / place).exists(), place


def test_every_name_that_the_map_names_can_be_imported_in_one_line():
    names = re.findall(r"`([A-Z]\w+\.\w+|[a-z]+_[a-z_]+|register|decide)`", TEXT)
    assert len(names) > 6
    for name in names:
        attrgetter(name)(ms_highway)
