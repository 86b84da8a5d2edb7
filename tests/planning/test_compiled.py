"""Compiled computations: packing, kernels, and JAX set up for low latency."""

import os
import subprocess
import sys

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.game.dynamics import keep_velocity, step
from ms_highway.game.features import reward
from ms_highway.metareasoning.compiled_decision import CompiledDecision
from ms_highway.metareasoning.rule import Outcome, decide, first_memory
from ms_highway.metareasoning.switching import Switching
from ms_highway.planning.compiled_plans import Costs, plan
from ms_highway.planning.human_models import MODELS, ladder
from ms_highway.planning.plans import cold_start
from ms_highway.runtime.compilation import in_one_kernel, jit_quickly

IN_A_PROCESS_OF_ITS_OWN = """
import os, sys
from ms_highway import low_latency
low_latency()
import jax, numpy as np
from ms_highway.game.scenario import build_game, draw_starts
from ms_highway.game.scenarios import STAY_BACK
from ms_highway.metareasoning.compiled_decision import CompiledDecision
from ms_highway.metareasoning.rule import first_memory
from ms_highway.metareasoning.switching import Switching
from ms_highway.planning.compiled_plans import CompiledPlans, Costs
from ms_highway.planning.human_models import ladder
game = build_game(STAY_BACK)
state = draw_starts(STAY_BACK, np.random.default_rng(0)).astype(np.float32)
function, *arguments = CompiledPlans(game, ladder(["naive"])).call(state, [0])
plan = function.lower(*arguments).compile()
compiled = [plan]
switching = Switching(Costs.of([0.09, 0.17], 1), 0.1, ladder(("naive", "turn")))
decisions = CompiledDecision(switching, game)
observed = decisions.arguments(first_memory(switching, 1), decisions.still(state))
if "decision" in sys.argv:
    compiled.append(decisions.function.lower(*observed).compile())
print(os.environ["XLA_FLAGS"])
for function in compiled:  # what is left to do outside of the kernel
    text = function.as_text()
    print(text[text.index("ENTRY"):].count(" fusion(") if 'xla_cpu_small_call="true"' in text else 1000)
print(jax.device_count())
print(*np.asarray(plan(*arguments)[0]).ravel().tolist())
"""


def run_with_low_latency(*compiled, **environment):
    clean = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    command = [sys.executable, "-c", IN_A_PROCESS_OF_ITS_OWN, *compiled]
    run = subprocess.run(command, capture_output=True, text=True, check=True, env=clean | environment)
    flags, *numbers, controls = run.stdout.splitlines()
    return flags, *(int(number) for number in numbers), np.array(controls.split(), dtype=float)


@pytest.mark.slow
@pytest.mark.parametrize("more", [[], pytest.param(["decision"], marks=pytest.mark.slow)])
def test_low_latency_makes_a_plan_and_a_decision_one_kernel_each_that_plans_the_same(played, more):
    _, *outside, _, controls = run_with_low_latency(*more)
    assert len(outside) == 1 + len(more)
    assert max(outside) < 5
    game, state = played("stay_back")
    expected = jax.jit(MODELS["naive"].plan)(game, state).robot
    np.testing.assert_allclose(controls.reshape(5, 2), expected, atol=1e-5)


@pytest.mark.slow
def test_low_latency_keeps_the_flags_that_the_user_has_set():
    flags, outside, devices, _ = run_with_low_latency(XLA_FLAGS="--xla_force_host_platform_device_count=2")
    assert "--xla_force_host_platform_device_count=2" in flags
    assert devices == 2
    assert outside < 5
    own = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=0"
    flags, outside, *_ = run_with_low_latency(XLA_FLAGS=own)
    assert flags == own
    assert outside == 1000


@pytest.mark.slow
def test_low_latency_leaves_a_file_of_flags_alone(tmp_path):
    file = tmp_path / "flags"
    file.write_text("--xla_force_host_platform_device_count=2\n")
    flags, _, devices, _ = run_with_low_latency(XLA_FLAGS=str(file))
    assert flags == str(file)
    assert devices == 2


def test_a_function_in_one_kernel_stays_the_same_function():
    def function(numbers, more):
        return numbers[:, None] * jnp.sin(more) + jnp.sum(numbers)

    numbers, more = jnp.array([0.3, -2.0]), jnp.linspace(-1, 1, 5)
    looped = jax.jit(in_one_kernel(function))
    np.testing.assert_allclose(looped(numbers, more), function(numbers, more), rtol=1e-6)
    np.testing.assert_allclose(looped(jnp.array([0.3, jnp.nan]), more), np.nan)
    assert np.isnan(looped(jnp.array([jnp.nan, 0.3]), more)).all()


def test_a_compiled_decision_is_the_decision_about_what_was_observed(played):
    """It recovers the human's control and the robot's reward from the states before and after the step."""
    game, before = played("merger", seed=4)
    rungs = ladder(("naive", "turn", "tom"))
    switching = jax.tree.map(jnp.asarray, Switching(Costs.of([0.09, 0.17, 0.37], 1), 0.1, rungs))
    scale = np.asarray(game.planner.control_scale)
    scaled = np.array([[-0.2, 0.1], [0.05, -0.3]], dtype=np.float32)
    dynamics = jax.tree.map(float, game.world)
    state = np.asarray(before, dtype=float)
    after = step(dynamics, state, np.concatenate([scaled * scale, keep_velocity(dynamics, state[2:])]))
    compiled, decided = CompiledDecision(switching, game), jit_quickly(decide)
    earned = reward(game.scene, game.robot, after.astype(np.float32))
    for rung in range(3):
        memory = first_memory(switching, 1)._replace(rungs=np.array([rung]), step=np.ones((), int))
        outcome = Outcome(before, after, scaled[0], scaled[1:], earned, cold_start(game, before))
        expected = decided(switching, game, memory, outcome)
        happened = compiled.still(state)._replace(control=scaled[0] * scale, after=after)
        decision, _ = compiled.decide(memory, happened)
        for found, wanted in zip(decision.memory, expected.memory, strict=True):
            np.testing.assert_array_equal(found, wanted)
        np.testing.assert_allclose(decision.gains, expected.gains, rtol=1e-2, atol=1e-3)


def test_a_state_needs_the_cars_of_the_game(played):
    game, state = played("dense_merge")
    with pytest.raises(ValueError, match="the state has 2 cars; the game has a robot and 2 humans"):
        plan(game, state[:2])
