"""Which model is this human? What a robot infers, in whom it trusts, and what is shown of it."""

import gymnasium as gym
import numpy as np
import pytest

from ms_highway.envs import environment_id
from ms_highway.envs.graphics import TEXT_WIDTH, model_color
from ms_highway.envs.short_names import named_controller
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.runner import make_environment
from ms_highway.experiments.simulated import any_batch
from ms_highway.game.crowd import Crowd
from ms_highway.metareasoning.compiled_belief import belief_function
from ms_highway.planning.road.settings import RUNGS
from ms_highway.runtime.packing import pack

NAIVE, IDM, TURN, TOM = range(4)
SEED = 3
TWO = {"humans": 2, "costs": "published"}


def drive(scenario, controller, steps=None, seed=SEED, **config):
    """The environment after an episode, all states, and all infos."""
    env = make_environment(scenario, controller, **config)
    env.reset(seed=seed)
    states, infos, done = [env.unwrapped.car_states], [], False
    while not done and len(infos) != steps:
        *_, terminated, truncated, info = env.step(0)
        done = terminated or truncated
        states.append(env.unwrapped.car_states)
        infos.append(info)
    return env.unwrapped, np.array(states), infos


@pytest.fixture(scope="module")
def trusted():
    """A robot that infers, and a human that yields."""
    return drive("merger", "tom+belief")


def test_a_human_that_yields_is_recognised_and_trusted(trusted):
    _, states, infos = trusted
    beliefs = np.array([info["belief"] for info in infos])
    assert beliefs.shape == (40, 1, 4)
    np.testing.assert_allclose(beliefs.sum(axis=-1), 1.0, rtol=1e-5)
    np.testing.assert_allclose(beliefs[0], 1 / 4)  # nothing was seen
    assert (beliefs[3:, 0, [TURN, TOM]].sum(axis=-1) > 0.85).all()
    assert states[-1, 0, 1] < -2.5  # in its lane


def test_trust_changes_nothing_and_without_a_belief_none_is_told(trusted):
    _, states, infos = drive("merger", "tom")
    np.testing.assert_array_equal(states, trusted[1])
    assert not any("belief" in info for info in infos)
    assert all(info["timing"].decision_seconds == 0 for info in infos)
    assert all(info["timing"].decision_seconds > 0 for info in trusted[2][1:])


@pytest.mark.parametrize("controller", ["tom", "learned:1", pytest.param("switching:0.1", marks=pytest.mark.slow)])
def test_nobody_merges_in_front_of_a_human_who_ignored_the_nudge(controller):
    _, states, infos = drive("merger", f"{controller}+belief", yielding="never")
    assert infos[5]["belief"][0, NAIVE] > 0.95
    assert {info["model"] for info in infos[5:]} == {"naive"}
    assert not any(info["collision"] for info in infos)
    assert (states[:, 0, 1] > -1.25).all()  # within its own lane


def test_who_counts_on_such_a_human_collides():
    assert any(info["collision"] for info in drive("merger", "tom", 15, yielding="never")[2])


def test_the_filter_is_compiled_once(trusted):
    game, robot = trusted[0].game, trusted[0].robot
    layout = pack(Crowd(game, np.asarray(game.human.weights)[None]))[1]
    assert belief_function(layout)._cache_size() == 1
    assert robot.last_step.belief.dtype == np.float32


@pytest.mark.parametrize("controller", ["tom+belief", "budget:100:one_step+belief"])
def test_each_human_of_a_crowd_has_a_belief_of_its_own(controller):
    _, _, infos = drive("dense_merge", controller, 12, yielding="never", way_out=False, **TWO)
    belief = infos[-1]["belief"]
    assert belief.shape == (2, 4)
    np.testing.assert_allclose(belief.sum(axis=1), 1.0, rtol=1e-5)
    ignored = belief[:, [TURN, TOM]].sum(axis=1) < 0.2
    assert ignored.any()
    assert all(rung == "naive" for rung, ignores in zip(infos[-1]["rungs"], ignored, strict=True) if ignores)


def test_who_never_yields_keeps_its_velocity_and_who_always_does_brakes_for_a_robot_beside_it():
    _, states, infos = drive("merger", "tom", 10, yielding="never")
    np.testing.assert_allclose(states[:, 1, 2:], np.tile(states[0, 1, 2:], (11, 1)), atol=1e-4)
    assert infos[-1]["human_status"] == "planned"
    _, states, _ = drive("merger", "naive", 10, yielding="always")
    np.testing.assert_allclose(np.diff(states[:, 1, 3]), -0.3)
    assert states[-1, 0, 1] > -1.25  # the robot is still in the other lane


def test_humans_who_keep_their_velocity_brake_for_slower_ones_but_not_for_the_robot():
    starts = np.array([[12.0, -3.3, 0, 15], [0, -3.3, 0, 20], [30, -3.3, 0, 10]])
    env = gym.make(environment_id("dense_merge"), config={**TWO, "yielding": "never"}).unwrapped
    env.reset(options={"initial_states": starts})
    env.step(0)
    assert starts[1, 3] > env.car_states[1, 3] > 19.5  # 2 m/s^2 for the slower human, not 5 for the robot
    assert env.car_states[2, 3] == pytest.approx(10.0)


def test_mixed_humans_are_drawn_for_every_episode():
    env = make_environment("dense_merge", "naive", yielding="mixed", humans=12, costs="published").unwrapped

    def drawn(seed):
        env.reset(seed=seed)
        return [car.controller.yields for car in env.road.vehicles[1:]]

    assert drawn(0) == drawn(0) != drawn(1)
    assert {*drawn(0)} == {True, False}


@pytest.mark.parametrize(
    ("scenario", "config"), [("merger", {}), ("dense_merge", TWO), ("dense_merge", TWO | {"humans": 12})]
)
def test_a_frame_shows_every_humans_belief(scenario, config):
    def shown(controller):
        env = make_environment(scenario, controller, render=True, **config)
        env.reset(seed=0)
        env.step(0)
        panel = env.render()[-env.unwrapped.viewer.panel_height :, :TEXT_WIDTH]
        return int((panel == model_color(RUNGS[IDM])).all(axis=-1).sum())

    assert shown("naive") == 0
    assert shown("naive+belief") > 500


@pytest.mark.parametrize("scenario", ["merger", "dense_merge"])
@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"yielding": "sometimes"}, r"config\['yielding'\] is 'sometimes'; choose one of 'usual', 'never', 'always'"),
        (
            {"controller": {"type": "fixed", "model": "tom", "belief": 1}},
            r"config\['controller'\]\['belief'\] is 1; it must be True or False",
        ),
        ({"controller": {"type": "fixed", "model": "tom", "beliefs": True}}, "did you mean 'belief'?"),
    ],
)
def test_impossible_configurations_are_refused_with_value_place_and_remedy(scenario, config, message):
    with pytest.raises(ValueError, match=message):
        gym.make(environment_id(scenario), config=config)


def test_a_short_name_may_end_in_belief_and_simulations_refuse_it():
    assert named_controller("tom@8+warm+belief").belief
    assert not named_controller("tom@8+warm").belief
    with pytest.raises(ValueError, match="unknown controller 'nobody'"):
        named_controller("nobody+belief")
    for comparison in (
        Comparison({"merger": ["tom+belief"]}),
        Comparison({"merger": ["tom"]}, planning={"yielding": "never"}),
    ):
        with pytest.raises(ValueError, match="the usual humans and no beliefs; use `compare`"):
            any_batch(comparison, "merger")
