"""What a human really does is anybody's to say: a function, a vehicle of highway-env, or a person at the keyboard."""

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
from ms_highway.loop.human_drivers import HUMAN_DRIVERS


def brakes(game, state):
    """Brake by 1 m/s^2 wherever the robot is."""
    return keep_velocity(game.world, state[0]) + jnp.array([0.0, -1.0])


def looks_for_itself(game, state):
    return [0.0, 4.0] if state[0, 0] > 0 else [0.0, 3.0]


@pytest.fixture
def added():
    for name, driver in {"brakes": brakes, "follows": IDMVehicle, "looks": looks_for_itself}.items():
        ms_highway.add_driver(name, driver)
    yield
    for name in ("brakes", "follows", "looks"):
        del HUMAN_DRIVERS[name]


@pytest.mark.usefixtures("added")
def test_a_function_drives_the_human_the_same_live_and_in_a_batch():
    _, states, *_ = drive(make("merger-v1", "naive", human_driver="brakes"), seed=0, steps=10)
    np.testing.assert_allclose(np.diff(states[:, 1, 3]), -0.1, atol=2e-3)  # m/s in 0.1 s
    comparison = Comparison({"merger-v1": ["naive"]}, seeds=1, config={"human_driver": "brakes"})
    simulated_speed = simulated(comparison)["human_speed"].to_numpy()[:10]
    np.testing.assert_allclose(simulated_speed, states[-10:, 1, 3], atol=1e-3)


@pytest.mark.usefixtures("added")
def test_a_vehicle_of_highway_env_drives_by_itself():
    env = make("merger-v1", "naive", human_driver="follows")
    _, states, _, infos = drive(env, seed=0, steps=10)
    assert type(env.unwrapped.humans[0]) is IDMVehicle
    assert infos[-1]["human_status"] == (None,)
    assert states[-1, 1, 3] < 15.0  # it is too close behind the car ahead, and brakes


@pytest.mark.usefixtures("added")
@pytest.mark.parametrize(
    ("driver", "message"),
    [
        ("follows", "'follows', which cannot be simulated"),
        ("looks", "cannot trace the human driver 'looks'.*use `compare`"),
    ],
)
def test_a_driver_that_cannot_be_simulated_is_refused_with_the_remedy(driver, message):
    with pytest.raises(ValueError, match=message):
        simulated(Comparison({"merger-v1": ["naive"]}, seeds=1, config={"human_driver": driver}))


def test_arrow_keys_drive_the_human(monkeypatch):
    env = make("merger-v1", "naive", human_driver="keyboard")
    env.reset(seed=0)
    with pytest.raises(OSError, match="render_mode='human'"):
        env.step(0)
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame.display.init()
    pygame.display.set_mode((10, 10))
    try:
        pressed = dict.fromkeys((pygame.K_UP, pygame.K_DOWN, pygame.K_LEFT, pygame.K_RIGHT), False)
        monkeypatch.setattr(pygame.key, "get_pressed", lambda: pressed | {pygame.K_DOWN: True, pygame.K_RIGHT: True})
        _, states, *_ = drive(env, seed=0, steps=5)
    finally:
        pygame.display.quit()
    np.testing.assert_allclose(np.diff(states[:, 1, 3]), -0.4, atol=0.05)
    assert states[-1, 1, 2] == pytest.approx(0.1, abs=1e-2)  # to the right


def test_what_is_no_driver_is_refused():
    with pytest.raises(ValueError, match="<class 'int'>"):
        ms_highway.add_driver("mine", int)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"human_driver": "nobody"}, "config\\['human_driver'\\] is 'nobody'; add it with ms_highway.add_driver"),
        ({"human_driver": "keyboard", "yielding": "never"}, "config\\['yielding'\\] is 'never'"),
        ({"other_vehicles_type": "ms_highway.vehicle.HumanVehicle"}, "no effect here; 'human_driver' says"),
        ({"show_trajectories": True}, "no effect here"),
    ],
)
def test_a_key_that_would_have_no_effect_is_refused(config, message):
    with pytest.raises(ValueError, match=message):
        make("merger-v1", "naive", **config)
