"""The wheel, away from the source tree."""

import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

USE = """
import gymnasium as gym, ms_highway, pathlib
assert "site-packages" in ms_highway.__file__, ms_highway.__file__
for name in ("py.typed", "data/report.html.jinja", "data/NOTICE.txt"):
    assert (pathlib.Path(ms_highway.__file__).parent / name).exists(), name
ms_highway.keep_compilations()
for name in ("stay-back", "merger", "give-way"):
    env = gym.make(f"ms-highway/{name}-v0", config={"controller": {"type": "fixed", "model": "naive"}})
    env.reset(seed=0)
    observation, reward, *_ = env.step(0)
    assert env.observation_space.contains(observation) and reward != 0
    print(name, reward)
"""


@pytest.mark.slow
def test_the_wheel_works_in_a_fresh_environment_from_another_directory(tmp_path):
    subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "--outdir", str(tmp_path), str(ROOT)],
        check=True,
        capture_output=True,
    )
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as files:
        (license,) = (files.read(name).decode() for name in files.namelist() if name.endswith("licenses/LICENSE"))
        assert "Copyright (c) 2026 the ms_highway authors" in license
        (metadata,) = (files.read(name).decode() for name in files.namelist() if name.endswith("/METADATA"))
        assert "License-Expression: MIT" in metadata
        assert "US-101" in files.read("ms_highway/data/NOTICE.txt").decode()
    home = tmp_path / "environment"
    venv.create(home, with_pip=True)
    here = [path for path in sys.path if path.endswith("site-packages")]
    python = str(home / "bin" / "python")
    subprocess.run([python, "-m", "pip", "install", "--quiet", "--no-deps", str(wheel)], check=True)
    packages = subprocess.run(
        [python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"],
        check=True,
        capture_output=True,
        text=True,
    ).stdout.strip()
    Path(packages, "dependencies.pth").write_text("\n".join(here))  # the dependencies, already installed, come after it
    run = subprocess.run([python, "-c", USE], cwd=tmp_path, check=True, capture_output=True, text=True)
    assert run.stdout.count("\n") == 3
