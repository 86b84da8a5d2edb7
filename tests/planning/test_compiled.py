"""Compiled computations: packing, kernels, and JAX set up for low latency."""

import os
import subprocess
import sys

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.planning.compiled_plans import plan
from ms_highway.planning.human_models import MODELS
from ms_highway.runtime.compilation import in_one_kernel

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
def test_low_latency_makes_a_plan_and_a_decision_one_kernel_each_that_plans_the_same(played):
    """Beside flags of the user's, which stay."""
    own = "--xla_force_host_platform_device_count=2"
    flags, *outside, devices, controls = run_with_low_latency("decision", XLA_FLAGS=own)
    assert own in flags
    assert devices == len(outside) == 2
    assert max(outside) < 5
    game, state = played("stay_back")
    expected = jax.jit(MODELS["naive"].plan)(game, state).robot
    np.testing.assert_allclose(controls.reshape(5, 2), expected, atol=1e-5)


@pytest.mark.slow
def test_low_latency_leaves_its_own_option_and_a_file_of_flags_as_the_user_has_set_them(tmp_path):
    own = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=0"
    flags, outside, *_ = run_with_low_latency(XLA_FLAGS=own)
    assert flags == own
    assert outside == 1000
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


def test_a_state_needs_the_cars_of_the_game(played):
    game, state = played("dense_merge")
    with pytest.raises(ValueError, match="the state has 2 cars; the game has a robot and 2 humans"):
        plan(game, state[:2])
