"""The package as it is imported and installed."""

import os
import shutil
import sysconfig
from importlib.metadata import Distribution
from pathlib import Path

import pytest
from commands import python
from test_pages import ROOT

IMPORTED = """
import sys
import gymnasium as gym
import ms_highway
assert "jax" not in sys.modules and "ms_highway.envs" not in sys.modules
assert {"highway-v0", "ms-highway/merger-v0"} <= set(gym.registry)
assert "ms-highway/demonstration-v0" in gym.registry
from ms_highway import *
assert "jax" in sys.modules and HumanVehicle is vehicle.HumanVehicle
"""


def install(target, *what):
    python(*f"-m pip install --quiet --no-deps --target {target}".split(), *what)


def test_an_import_registers_environments_and_loads_names_only_when_used():
    python("-W", "error::ImportWarning", "-c", IMPORTED)


def test_the_package_is_found_above_a_checkout_so_named(tmp_path):
    (tmp_path / "ms_highway" / "ms_highway").mkdir(parents=True)
    python(
        "-c",
        "import ms_highway; assert ms_highway.__file__, 'it is a namespace'",
        cwd=tmp_path,
    )


@pytest.fixture
def checkout_without_links(tmp_path):
    """Copy the project as Git checks it out on systems without symbolic links, which
    get a text file instead.

    The directory has the package's name, as that of a clone may have.
    """
    source = tmp_path / "ms_highway"
    shutil.copytree(
        ROOT / "ms_highway",
        source / "ms_highway",
        ignore=lambda folder, names: {"envs", "__pycache__"},
    )
    shutil.copytree(ROOT / "envs", source / "envs")
    (source / "ms_highway" / "envs").write_text("../envs")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    return source


@pytest.mark.slow
def test_the_wheel_works_from_another_directory_without_the_source_tree(
    checkout_without_links, tmp_path
):
    source = checkout_without_links
    installed = tmp_path / "installed"
    install(installed, source)
    shutil.rmtree(source)
    (metadata,) = installed.glob("*.dist-info")
    assert (
        "Copyright (c) 2026 the ms_highway authors"
        in (metadata / "licenses" / "LICENSE").read_text()
    )
    assert Distribution.at(metadata).metadata["License-Expression"] == "MIT"
    package = installed / "ms_highway"
    for name in ("py.typed", "__init__.pyi", "data/report.html.jinja"):
        assert (package / name).exists(), name
    packaged = {path.relative_to(package) for path in package.rglob("*.py")}
    written = {
        path.relative_to(ROOT / "ms_highway")
        for path in (ROOT / "ms_highway").rglob("*.py")
    }
    written |= {path.relative_to(ROOT) for path in (ROOT / "envs").glob("*.py")}
    assert packaged == written
    assert "US-101" in (package / "data" / "NOTICE.txt").read_text()
    shutil.copy(Path(__file__).with_name("test_drive.py"), tmp_path)
    program = (
        "import ms_highway, pytest, sys\n"
        f"assert ms_highway.__file__.startswith({str(installed)!r})\n"
        "sys.exit(pytest.main(['-q', '-W', 'error', 'test_drive.py']))"
    )
    python(
        "-c", program, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(installed)}
    )


@pytest.mark.slow
def test_an_editable_installation_needs_neither_place_nor_links(
    checkout_without_links, tmp_path
):
    source = checkout_without_links
    installed = tmp_path / "installed"
    install(installed, "-e", source)
    program = (
        f"import site, sys\nsite.addsitedir({str(installed)!r});"
        f" sys.path.append({sysconfig.get_path('purelib')!r})\nimport gymnasium,"
        " ms_highway, ms_highway.envs\nassert ms_highway.__file__ =="
        f" {str(source / 'ms_highway' / '__init__.py')!r}, ms_highway.__path__\nassert"
        f" ms_highway.envs.__file__ == {str(source / 'envs' / '__init__.py')!r},"
        " ms_highway.envs.__file__\nassert"
        " gymnasium.make('ms-highway/merger-v1').reset(seed=0)"
    )
    alone = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    python(
        "-S", "-c", program, cwd=tmp_path, env=alone
    )  # `site` would find an editable installation of this checkout
