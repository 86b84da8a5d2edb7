"""Drivers of the real humans: functions, vehicles of highway-env, and a person at the
keyboard.
"""

from collections import Counter
from copy import deepcopy

import gymnasium as gym
import jax
import numpy as np
import pygame
import pytest
from episodes import drive, make
from highway_env.vehicle.behavior import IDMVehicle
from jax import numpy as jnp

import ms_highway
from ms_highway.experiments.batch import simulated
from ms_highway.experiments.comparison import Comparison
from ms_highway.game.dynamics import keep_velocity
from ms_highway.loop.controller import HUMAN_DRIVERS, traceable


def brakes(game, state):
    """Brake by 1 m/s^2 wherever the robot is."""
    return keep_velocity(game.world, state[0]) + jnp.array([0.0, -1.0])


def looks_for_itself(game, state):
    return [0.0, 4.0] if state[0, 0] > 0 else [0.0, 3.0]


class Remembers:
    """Accelerate by the way of the last six steps, and by chance."""

    def reset(self, key):
        self.places = []
        self.random = np.random.default_rng(key)

    def __call__(self, game, state):
        self.places = [*self.places[-5:], state[0, 0]]
        way = self.places[-1] - self.places[0]
        return keep_velocity(game.world, state[0]) + np.array(
            [0.0, 0.1 * way + self.random.normal()]
        )


def leaks(game, state, places=[]):  # noqa: B006
    """Remember the last six steps, also those of the episode before."""
    places[:] = [*places[-5:], state[0, 0]]
    return keep_velocity(game.world, state[0]) + np.array(
        [0.0, 0.1 * (places[-1] - places[0])]
    )


def draws(game, state):
    return [0.0, np.random.default_rng().normal()]


def counts(game, state, calls=[0]):  # noqa: B006
    calls[0] += 1
    return keep_velocity(game.world, state[0]) + jnp.array([0.0, -0.1 * calls[0]])


KEY = jax.random.key(0)


def swerves_as_it_was_drawn(game, state):
    """Pure, as its key is always the same."""
    return keep_velocity(game.world, state[0]) + 0.001 * jax.random.normal(KEY, (2,))


def forgets_the_reward(game, state):
    game.robot.weights[:] = 0.0
    return [0.0, 4.0]


def moves_the_cars(game, state):
    state[:, 0] += 10.0
    return [0.0, 4.0]


def batch_of(driver):
    config = {"human_driver": driver, "ladder": ["naive"]}
    return simulated(Comparison({"merger-v1": ["naive"]}, seeds=1, config=config))


@pytest.fixture
def added():
    drivers = {
        "brakes": brakes,
        "follows": IDMVehicle,
        "looks": looks_for_itself,
        "remembers": Remembers(),
        "made": Remembers,
        "leaks": leaks,
        "draws": draws,
        "counts": counts,
        "swerves": swerves_as_it_was_drawn,
        "forgets": forgets_the_reward,
        "moves": moves_the_cars,
    }
    for name, driver in drivers.items():
        ms_highway.add_driver(name, driver)
    yield
    for name in drivers:
        del HUMAN_DRIVERS[name]


@pytest.mark.usefixtures("added")
def test_a_function_drives_humans_alike_live_and_in_batches():
    _, states, *_ = drive(make("merger-v1", human_driver="brakes"), steps=10)
    np.testing.assert_allclose(
        np.diff(states[:, 1, 3]), -0.1, atol=2e-3
    )  # m/s in 0.1 s
    speeds = batch_of("brakes")["human_speed"].to_numpy()[:10]
    np.testing.assert_allclose(speeds, states[-10:, 1, 3], atol=1e-3)


@pytest.mark.usefixtures("added")
def test_a_function_that_draws_by_one_key_is_simulated():
    game = make("merger-v1").unwrapped.game
    assert traceable("swerves", game) is swerves_as_it_was_drawn


@pytest.mark.usefixtures("added")
def test_a_vehicle_of_highway_env_drives_by_itself():
    env = make("merger-v1", human_driver="follows")
    _, states, _, infos = drive(env, steps=10)
    assert type(env.unwrapped.humans[0]) is IDMVehicle
    assert infos[-1]["human_status"] == (None,)
    assert states[-1, 1, 3] < 15.0  # it brakes behind the car ahead


@pytest.mark.usefixtures("added")
@pytest.mark.parametrize(
    ("driver", "message"),
    [
        ("follows", "'follows', which cannot be simulated"),
        ("looks", "cannot trace the human driver 'looks'.*use `compare`"),
        (
            "remembers",
            "'remembers', which remembers and cannot be simulated.*use `compare`",
        ),
        (
            "counts",
            (
                "'counts' computes something else when it is asked again; give"
                " add_driver an object with `reset"
            ),
        ),
    ],
)
def test_a_driver_that_is_not_simulated_is_refused(driver, message):
    with pytest.raises(ValueError, match=message):
        batch_of(driver)
    with pytest.raises(ValueError, match="<class 'int'>"):
        ms_highway.add_driver("mine", int)


@pytest.mark.usefixtures("added")
@pytest.mark.parametrize(
    "how",
    [
        {"controller": "remembers"},
        {"controller": "made"},
        {"human_driver": "remembers"},
    ],
)
def test_a_driver_that_remembers_begins_anew_and_is_copied(
    how,
):
    env = make("merger-v1", **how)
    alone = drive(env, seed=4, steps=10).states
    other = drive(env, seed=0, steps=10).states
    np.testing.assert_array_equal(drive(env, seed=4, steps=5).states, alone[:6])
    copied = deepcopy(env)
    for each in (env, copied, env):  # a copy's steps are not the original's
        each.step(0)
    np.testing.assert_array_equal(copied.unwrapped.car_states, alone[6])
    np.testing.assert_array_equal(env.unwrapped.car_states, alone[7])
    driven = 0 if "controller" in how else 1
    gained = [np.diff(states[:, driven, 3]) for states in (alone, other)]
    assert not np.allclose(*gained, atol=1e-2)  # as their keys differ


@pytest.mark.usefixtures("added")
@pytest.mark.parametrize("role", ["controller", "human_driver"])
@pytest.mark.parametrize(
    ("driver", "message"),
    [
        (
            "leaks",
            (
                "'leaks' returned .* in the same state, so it remembers or draws; .*"
                " `reset\\(key\\)`"
            ),
        ),
        (
            "draws",
            (
                "'draws' returned .* in the same state, so it remembers or draws; .*"
                " `reset\\(key\\)`"
            ),
        ),
        (
            "counts",
            (
                "'counts' returned .* in the same state, so it remembers or draws; .*"
                " `reset\\(key\\)`"
            ),
        ),
        (
            "forgets",
            (
                "'forgets' writes into an array that it was given; copy an array before"
                " you change it"
            ),
        ),
        (
            "moves",
            (
                "'moves' writes into an array that it was given; copy an array before"
                " you change it"
            ),
        ),
    ],
)
def test_an_impure_function_is_found_within_an_episode(driver, role, message):
    with pytest.raises(ValueError, match=message):
        drive(make("merger-v1", **{role: driver}))


def test_an_object_that_cannot_begin_an_episode_is_refused():
    takes_no_key = type("TakesNoKey", (Remembers,), {"reset": lambda self: None})
    needs_numbers = type(
        "NeedsNumbers", (Remembers,), {"__init__": lambda self, number: None}
    )
    for driver in (takes_no_key, takes_no_key(), needs_numbers):
        with pytest.raises(
            ValueError, match=r"cannot begin an episode: .*`reset` take a key"
        ):
            ms_highway.add_driver("mine", driver)
    never_called = type("NeverCalled", (), {"reset": lambda self, key: None})
    with pytest.raises(
        ValueError, match=r"an object with `reset\(key\)` that is called like one"
    ):
        ms_highway.add_driver("mine", never_called())


def test_arrow_keys_drive_the_human(monkeypatch):
    with pytest.raises(
        OSError,
        match=(
            "no window to press keys in; make the environment with render_mode='human'"
        ),
    ):
        make("merger-v1", human_driver="keyboard").reset(seed=0)
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame.display.init()
    pygame.display.set_mode((10, 10))
    try:
        pressed = Counter([pygame.K_DOWN, pygame.K_RIGHT])
        monkeypatch.setattr(pygame.key, "get_pressed", lambda: pressed)
        _, states, *_ = drive(make("merger-v1", human_driver="keyboard"), steps=5)
    finally:
        pygame.display.quit()
    np.testing.assert_allclose(np.diff(states[:, 1, 3]), -0.4, atol=0.05)
    assert states[-1, 1, 2] == pytest.approx(0.1, abs=1e-2)  # to the right


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (
            {"human_driver": "nobody"},
            "config\\['human_driver'\\] is 'nobody'; add it with ms_highway.add_driver",
        ),
        (
            {"human_driver": "keyboard", "yielding": "never"},
            "config\\['yielding'\\] is 'never'",
        ),
        (
            {"other_vehicles_type": "ms_highway.vehicle.HumanVehicle"},
            "no effect here; 'human_driver' says",
        ),
    ],
)
def test_an_unknown_driver_and_a_key_without_effect_are_refused(config, message):
    with pytest.raises(ValueError, match=message):
        make("merger-v1", **config)


@pytest.mark.parametrize(
    ("scenario", "config"),
    [
        ("merger-v1", {"human_driver": "keyboard", "controller": "tom"}),
        ("demonstration-v0", {"manual_control": True}),
    ],
)
def test_keys_without_a_display_are_refused_in_one_sentence(
    scenario, config, monkeypatch
):
    for variable in ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(variable, raising=False)
    pygame.display.quit()
    env = gym.make(
        f"ms_highway:ms-highway/{scenario}", render_mode="human", config=config
    )
    try:
        with pytest.raises(
            OSError, match="there is no display for a person to drive at; use a desktop"
        ):
            env.reset(seed=0)
    finally:
        env.close()
    monkeypatch.setenv("SDL_VIDEODRIVER", "x11")
    with pytest.raises(
        OSError, match="there is no display for the window of render_mode='human'"
    ):
        gym.make(
            f"ms_highway:ms-highway/{scenario}", render_mode="human", config=config
        )
    pygame.display.quit()
