"""Compiled computations: their size, and JAX set up for low latency."""

import os

import jax
import numpy as np
import pytest
from commands import python

from ms_highway.envs import SCENARIOS
from ms_highway.planning.compiled_plans import CompiledPlans, checked_state, plan
from ms_highway.planning.human_models import plan_alone
from ms_highway.planning.ladders import ladder

IN_A_PROCESS_OF_ITS_OWN = """
import os
from ms_highway import low_latency
low_latency()
import jax, numpy as np
from ms_highway.game.scenario import build_game
from ms_highway.game.starts import draw_starts
from ms_highway.game.scenarios import STAY_BACK
from ms_highway.planning.compiled_plans import CompiledPlans
from ms_highway.planning.ladders import ladder
state = draw_starts(STAY_BACK, np.random.default_rng(0)).astype(np.float32)
plans = CompiledPlans(build_game(STAY_BACK), ladder(["naive"]))
function, *arguments = plans.call(state, [0])
plan = function.lower(*arguments).compile()
print(os.environ["XLA_FLAGS"])
print('xla_cpu_small_call="true"' in plan.as_text())  # whether a loop is one kernel
print(jax.device_count())
print(*np.asarray(plan(*arguments).plan.robot).ravel().tolist())
"""


def run_with_low_latency(**environment):
    clean = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    done = python("-c", IN_A_PROCESS_OF_ITS_OWN, env=clean | environment)
    flags, fused, devices, controls = done.stdout.splitlines()
    return flags, fused == "True", int(devices), np.array(controls.split(), dtype=float)


@pytest.mark.slow
def test_low_latency_makes_the_steps_of_a_plan_one_kernel(played):
    """Beside flags of the user's, which stay."""
    own = "--xla_force_host_platform_device_count=2"
    flags, fused, devices, controls = run_with_low_latency(XLA_FLAGS=own)
    assert own in flags
    assert fused
    assert devices == 2
    game, state = played("stay_back")
    expected = jax.jit(plan_alone)(game, state).plan.robot
    np.testing.assert_allclose(controls.reshape(5, 2), expected, atol=1e-5)


@pytest.mark.slow
def test_low_latency_leaves_flags_as_the_user_has_set_them(
    tmp_path,
):
    own = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=0"
    flags, fused, *_ = run_with_low_latency(XLA_FLAGS=own)
    assert flags == own
    assert not fused
    file = tmp_path / "flags"
    file.write_text("--xla_force_host_platform_device_count=2\n")
    flags, _, devices, _ = run_with_low_latency(XLA_FLAGS=str(file))
    assert flags == str(file)
    assert devices == 2


MAX_LINES = {"stay_back": 1100, "merger": 2500, "crossing_crowd": 8000}
"""Of StableHLO, in any plan of a scenario's ladder: what users wait for in their first
step grows with it.
"""


@pytest.mark.parametrize("name", MAX_LINES)
def test_the_programs_of_plans_stay_small(played, name):
    game, state = played(name, humans=None, planning=None)
    plans = CompiledPlans(game, ladder(SCENARIOS[name].ladder))
    rungs = range(1 if game.number > 1 else len(plans.ladder))
    calls = [plans.call(checked_state(state), [rung] * game.number) for rung in rungs]
    lines = [
        len(function.lower(*arguments).as_text().splitlines())
        for function, *arguments in calls
    ]
    assert max(lines) < MAX_LINES[name], lines


def test_a_state_needs_the_cars_of_the_game(played):
    game, state = played("dense_merge")
    with pytest.raises(
        ValueError, match="the state has 2 cars; the game has a robot and 2 humans"
    ):
        plan(game, state[:2])
