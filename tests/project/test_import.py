"""Importing the package: what is there, and what is not loaded."""

import ast
import subprocess
import sys
from pathlib import Path

import ms_highway

IMPORTED = """
import sys
import gymnasium as gym
import ms_highway
assert "jax" not in sys.modules and "ms_highway.envs" not in sys.modules
assert {"highway-v0", "ms-highway/merger-v0", "ms-highway/demonstration-v0"} <= set(gym.registry)
from ms_highway import *
assert "jax" in sys.modules and HumanVehicle is envs.base.HumanVehicle
"""


def test_an_import_registers_all_environments_and_loads_public_names_when_they_are_used():
    subprocess.run([sys.executable, "-W", "error::ImportWarning", "-c", IMPORTED], check=True)


def test_type_checkers_see_the_names_that_are_loaded_lazily():
    tree = ast.parse(Path(ms_highway.__file__).read_text())
    (block,) = [node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    seen = {name.name: node.module for node in block.body for name in node.names}
    assert seen == {name: f"ms_highway.{home}" for name, home in ms_highway._HOMES.items()}


def test_a_name_that_is_not_public_is_refused_as_python_refuses_it():
    assert not hasattr(ms_highway, "climb")
    assert set(ms_highway.__all__) <= set(dir(ms_highway))
