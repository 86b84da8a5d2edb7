"""What the tests share: games, starts, reference episodes, and one compilation cache for all processes."""

import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.game import scenarios
from ms_highway.game.game import Game
from ms_highway.game.planning_settings import PlanningSettings
from ms_highway.game.scenario import PAPER_UNIT, Scenario, build_game, draw_episode
from ms_highway.irl.recordings.commonroad import read_directory
from ms_highway.irl.recordings.recording import Recording
from ms_highway.runtime.jax_settings import keep_compilations

SCENARIOS = {each.name: each for each in vars(scenarios).values() if isinstance(each, Scenario)}

XLA_DEFAULTS = "--xla_cpu_max_isa= --xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1024"
"""XLA's own defaults, stated so that commands leave them unchanged. XLA reads its flags once, but JAX names a compiled
function after the flags of the moment: after a test of a command, others would compile theirs again."""


@pytest.fixture(scope="session", autouse=True)
def shared_compilation_cache() -> Path:
    """All runs, their workers, and the processes that they start, find what one of them has compiled already.

    JAX's keys hold the program, the compiler's options and the versions, so that the cache needs no other key.
    """
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    cache = str(home / "ms-highway-tests")
    settings = {"jax_compilation_cache_dir": cache, "jax_persistent_cache_min_compile_time_secs": 0.1}
    for name, value in settings.items():
        os.environ[name.upper()] = str(value)
    os.environ.setdefault("XLA_FLAGS", XLA_DEFAULTS)
    return keep_compilations(Path(cache))


@pytest.fixture(autouse=True)
def still_shared(shared_compilation_cache: Path) -> Iterator[None]:
    """Go back to that cache after tests of others, and of none."""
    yield
    if jax.config.jax_compilation_cache_dir != str(shared_compilation_cache):
        keep_compilations(shared_compilation_cache)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Reading recordings of real drivers takes long."""
    for item in items:
        if "us101" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.slow)


@pytest.fixture(scope="session")
def reference() -> Path:
    """The directory of the reference episodes."""
    default = Path(__file__).parents[2] / "shared" / "reference" / "episodes"
    directory = Path(os.environ.get("MS_HIGHWAY_REFERENCE", default))
    if not list(directory.glob("*.npz")):
        pytest.skip(f"no reference episodes in {directory}; set MS_HIGHWAY_REFERENCE to their directory")
    return directory


@pytest.fixture(scope="session")
def us101_directory() -> Path:
    """The directory of human driving on the US-101 highway."""
    default = Path(__file__).parents[2] / "shared" / "human_driving" / "us101"
    directory = Path(os.environ.get("MS_HIGHWAY_HUMAN_DRIVING", default))
    if not list(directory.glob("*.xml.gz")):
        pytest.skip(f"no human driving in {directory}; set MS_HIGHWAY_HUMAN_DRIVING to its directory")
    return directory


@pytest.fixture(scope="session")
def us101(us101_directory: Path) -> list[Recording]:
    """Human driving on the US-101 highway."""
    return read_directory(us101_directory)


@pytest.fixture(params=[name for name, scenario in SCENARIOS.items() if not scenario.streams])
def scenario(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="session")
def played() -> Callable[..., tuple[Game, jax.Array]]:
    """A scenario's game, with anything that `build_game` takes, and a drawn start in the game's unit.

    Scenarios with streams have two humans and plans of five steps within their limits, unless the options say
    otherwise. In the others, further humans follow the first one, 30 m apart.
    """

    def make(name: str, seed: int = 0, **options: object) -> tuple[Game, jax.Array]:
        scenario = SCENARIOS[name]
        small = {"humans": 2, "planning": PlanningSettings(horizon=5)}
        limits = {"control_limit": scenario.control_limit, "grip": scenario.grip}
        game = build_game(scenario, **(small | limits if scenario.streams else {}) | options)
        start, _ = draw_episode(scenario, np.random.default_rng(seed), game.humans)
        followers = 0 if scenario.streams else game.number - 1
        behind = [start[1] - [30.0 * (1 + place), 0, 0, 0] for place in range(followers)]
        if behind:
            start, leader = np.insert(start, 2, behind, axis=0), game.scene.leader
            game = replace(game, scene=replace(game.scene, leader=leader and leader + followers))
        unit = float(game.scene.length_unit) / PAPER_UNIT
        return game, jnp.asarray(start * [unit, unit, 1, unit], dtype=jnp.float32)

    return make
