"""Fixtures of all tests: games, starts, reference episodes, and one cache of compiled
functions for all runs.
"""

import os
import resource
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import accumulate
from pathlib import Path

import jax
import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle
from jax import numpy as jnp

from ms_highway.cli.main import main
from ms_highway.game.game import Game
from ms_highway.game.scenario import PAPER_UNIT, Scenario, build_game
from ms_highway.game.scenarios import (
    CROSSING_CROWD,
    DENSE_MERGE,
    GIVE_WAY,
    MERGER,
    STAY_BACK,
)
from ms_highway.game.starts import draw_episode
from ms_highway.numerics.solvers import PlanningSettings
from ms_highway.runtime import compilation
from ms_highway.runtime.jax_settings import keep_compilations

SCENARIOS = {
    scenario.name: scenario
    for scenario in (STAY_BACK, MERGER, GIVE_WAY, DENSE_MERGE, CROSSING_CROWD)
}

CACHE = (
    Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    / "ms-highway-tests"
)
LARGEST = 500e6  # bytes of the cache
MAX_MEMORY = 3e6  # kB of a worker

XLA_DEFAULTS = (
    "--xla_cpu_max_isa="
    " --xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1024"
)
"""XLA's own defaults, set so that commands leave them unchanged. XLA reads its flags
once, but JAX files a compiled function under the present flags: after the test of a
command, other tests would compile their functions again.
"""


def pytest_configure(config: pytest.Config) -> None:
    """Before any worker begins, remove the least recently used files from the cache,
    beyond its largest size.
    """
    if not hasattr(config, "workerinput"):
        found = []
        for file in CACHE.glob("*"):
            with suppress(FileNotFoundError):  # another run removes files, too
                found.append((file.stat(), file))
        found.sort(key=lambda entry: entry[0].st_atime, reverse=True)
        for (_, file), size in zip(
            found, accumulate(kept.st_size for kept, _ in found), strict=True
        ):
            if size > LARGEST:
                file.unlink(missing_ok=True)


@pytest.fixture(scope="session", autouse=True)
def shared_cache() -> None:
    """Let all runs, their workers and the processes that they start share what one of
    them has compiled.

    JAX's keys hold the program, the compiler's options and the versions, so that the
    cache needs no other key.
    """
    optimize(False)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(CACHE)
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.1"
    os.environ.setdefault("XLA_FLAGS", XLA_DEFAULTS)
    keep_compilations(CACHE)


def optimize(on: bool) -> None:
    """Switch the optimisations of JAX's compiler on or off, in this process and in
    those that it starts.
    """
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = str(not on)
    jax.config.update("jax_disable_most_optimizations", not on)


def forget_compiled() -> None:
    """Clear all compiled functions, so that the next call compiles them and warms them
    up again.
    """
    jax.clear_caches()
    compilation._warm.clear()


@pytest.fixture(scope="module")
def optimized() -> Iterator[None]:
    """Compile with optimisations, as users do, up to the end of the file. Tests that
    drive long episodes need this.
    """
    forget_compiled()
    optimize(True)
    yield
    optimize(False)
    forget_compiled()


@pytest.fixture(autouse=True)
def still_shared() -> Iterator[None]:
    """Return to the shared cache after tests that use another cache or none."""
    yield
    if jax.config.jax_compilation_cache_dir != str(CACHE):
        keep_compilations(CACHE)


@pytest.fixture(autouse=True)
def drivers_as_they_were() -> Iterator[None]:
    """Undo what stock intersections change in the class of highway-env's drivers, which
    all scenes share.
    """
    before = {
        name: getattr(IDMVehicle, name)
        for name in ("DISTANCE_WANTED", "COMFORT_ACC_MAX", "COMFORT_ACC_MIN")
    }
    yield
    for name, value in before.items():
        setattr(IDMVehicle, name, value)


@pytest.fixture
def stopped_by_nans() -> Iterator[None]:
    """Let JAX raise an error if a compiled function returns a NaN, as under
    JAX_DEBUG_NANS=1.
    """
    with jax.debug_nans(True):
        yield


@pytest.fixture(scope="module", autouse=True)
def little_memory() -> Iterator[None]:
    """Forget compiled functions if they take much memory; those of all tests would take
    many gigabytes.
    """
    yield
    if resource.getrusage(resource.RUSAGE_SELF).ru_maxrss > MAX_MEMORY:
        forget_compiled()


def _shared(what: str, variable: str, folder: str, pattern: str) -> Path:
    """Return a directory of data beside the project, or skip the test."""
    beside = Path(__file__).parents[2] / "shared" / folder
    directory = Path(os.environ.get(variable, beside))
    if not list(directory.glob(pattern)):
        pytest.skip(
            f"needs {what}, but there is no {pattern} in {directory}; set {variable} to"
            " their directory"
        )
    return directory


@pytest.fixture(scope="session")
def reference() -> Path:
    """The directory of the reference episodes."""
    return _shared(
        "the logs of the paper's released code",
        "MS_HIGHWAY_REFERENCE",
        "reference/episodes",
        "*.npz",
    )


@pytest.fixture(scope="session")
def us101_directory() -> Path:
    """The directory of human driving on the US-101 highway."""
    return _shared(
        "recordings of US-101",
        "MS_HIGHWAY_HUMAN_DRIVING",
        "human_driving/us101",
        "*.xml.gz",
    )


@pytest.fixture
def refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[[str], str]:
    """Return a function that runs a command, which must be refused and write nothing,
    and returns its one line.
    """

    def refusal(command: str) -> str:
        monkeypatch.chdir(tmp_path)
        before = sorted(tmp_path.rglob("*"))
        capsys.readouterr()
        assert main(command.split(" ")) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert sorted(tmp_path.rglob("*")) == before
        return line

    return refusal


@pytest.fixture(params=["stay_back", "merger", "give_way"])
def scenario(request: pytest.FixtureRequest) -> str:
    """The paper's scenarios."""
    return request.param


@pytest.fixture(scope="session")
def played() -> Callable[..., tuple[Game, jax.Array]]:
    """Return a function that makes a scenario's game, with options of `build_game`, and
    a start in the game's unit.

    By default, scenarios with streams have two humans, and plans of five steps within
    their limits. In the others, further humans follow the first one, 30 m apart.
    """

    def make(
        which: str | Scenario, seed: int = 0, **options: object
    ) -> tuple[Game, jax.Array]:
        scenario = SCENARIOS[which] if isinstance(which, str) else which
        small = {"humans": 2, "planning": PlanningSettings(horizon=5)}
        limits = {"control_limit": scenario.control_limit, "grip": scenario.grip}
        game = build_game(
            scenario, **(small | limits if scenario.streams else {}) | options
        )
        start, _ = draw_episode(scenario, np.random.default_rng(seed), game.humans)
        followers = 0 if scenario.streams else game.number - 1
        behind = [
            start[1] - [30.0 * (1 + place), 0, 0, 0] for place in range(followers)
        ]
        if behind:
            start = np.insert(start, 2, behind, axis=0)
            leader = game.scene.leader
            game = replace(
                game, scene=replace(game.scene, leader=leader and leader + followers)
            )
        unit = float(game.scene.length_unit) / PAPER_UNIT
        return game, jnp.asarray(start * [unit, unit, 1, unit], dtype=jnp.float32)

    return make
