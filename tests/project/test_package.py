"""The package as it is imported and installed."""

import os
import shutil
import subprocess
import sys
from importlib.metadata import Distribution
from pathlib import Path

import pytest

import ms_highway

ROOT = Path(__file__).parents[2]

IMPORTED = """
import sys
import gymnasium as gym
import ms_highway
assert "jax" not in sys.modules and "ms_highway.envs" not in sys.modules
assert {"highway-v0", "ms-highway/merger-v0", "ms-highway/demonstration-v0"} <= set(gym.registry)
from ms_highway import *
assert "jax" in sys.modules and HumanVehicle is vehicle.HumanVehicle
"""


def test_an_import_registers_all_environments_and_loads_public_names_when_they_are_used():
    subprocess.run([sys.executable, "-W", "error::ImportWarning", "-c", IMPORTED], check=True)


def test_a_name_that_is_not_public_is_refused_as_python_refuses_it():
    assert not hasattr(ms_highway, "climb")
    assert set(ms_highway.__all__) <= set(dir(ms_highway))


@pytest.mark.slow
def test_the_wheel_works_from_another_directory_without_the_source_tree(tmp_path):
    source, installed = tmp_path / "source", tmp_path / "installed"
    for folder in ("ms_highway", "envs"):
        shutil.copytree(ROOT / folder, source / folder, symlinks=True)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(installed), str(source)]
    subprocess.run(pip, check=True)
    shutil.rmtree(source)
    (metadata,) = installed.glob("*.dist-info")
    assert "Copyright (c) 2026 the ms_highway authors" in (metadata / "licenses" / "LICENSE").read_text()
    assert Distribution.at(metadata).metadata["License-Expression"] == "MIT"
    package = installed / "ms_highway"
    for name in ("py.typed", "__init__.pyi", "data/report.html.jinja"):
        assert (package / name).exists(), name
    assert "US-101" in (package / "data" / "NOTICE.txt").read_text()
    shutil.copy(Path(__file__).with_name("test_drive.py"), tmp_path)
    program = (
        "import ms_highway, pytest, sys\n"
        f"assert ms_highway.__file__.startswith({str(installed)!r})\n"
        "sys.exit(pytest.main(['-q', '-W', 'error', 'test_drive.py']))"
    )
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    subprocess.run([sys.executable, "-c", program], cwd=tmp_path, env=environment, check=True)
