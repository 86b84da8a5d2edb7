"""Importing the package: what is there, and what is not loaded."""

import subprocess
import sys

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


def test_a_name_that_is_not_public_is_refused_as_python_refuses_it():
    assert not hasattr(ms_highway, "climb")
    assert set(ms_highway.__all__) <= set(dir(ms_highway))
