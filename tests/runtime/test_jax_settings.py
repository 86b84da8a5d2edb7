"""Compiled functions that are kept on disk, and single precision everywhere."""

import os

import jax
import numpy as np
import pytest
from commands import python

from ms_highway.runtime.jax_settings import keep_compilations


def test_a_compiled_function_is_used_again_unless_it_is_damaged(tmp_path):
    kept = keep_compilations(tmp_path / "kept")
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)

    def compute():
        """Let JAX compile a new function, or fetch it from where the same program is
        kept.
        """
        result = jax.jit(lambda x: 3 * x + 1)(np.arange(4.0, dtype=np.float32))
        np.testing.assert_array_equal(result, [1, 4, 7, 10])
        return {file: file.read_bytes() for file in kept.iterdir()}

    before = compute()
    assert before
    assert kept.stat().st_mode & 0o777 == 0o700
    assert compute() == before
    for file, content in before.items():
        file.write_bytes(content[: len(content) // 2])
    with pytest.warns(UserWarning, match="Error reading persistent compilation cache"):
        compute()


def test_a_directory_that_others_may_write_to_is_refused(tmp_path):
    tmp_path.chmod(0o770)
    with pytest.raises(PermissionError, match=f"chmod go-w {tmp_path}"):
        keep_compilations(tmp_path)
    assert jax.config.jax_compilation_cache_dir is None
    if os.getuid() == 0:  # who may give directories away
        tmp_path.chmod(0o700)
        os.chown(tmp_path, 12345, 12345)
        with pytest.raises(PermissionError, match="choose a directory of your own"):
            keep_compilations(tmp_path)


DOUBLE_PRECISION = """
import warnings
import gymnasium
import jax
import ms_highway
from ms_highway.cli.main import main
from ms_highway.experiments.runner import make_environment

warnings.filterwarnings("error", message="Explicitly requested dtype")
assert jax.config.jax_enable_x64
for scenario, *controllers in (
    ("dense_merge", "budget:60000"),
    ("merger", "switching:0.1", "horizon:0.1", "tom@8+warm"),
):
    for name in controllers:
        env = make_environment(scenario, name)
        env.reset(seed=0)
        for _ in range(2):
            *_, info = env.step(0)
            assert info["status"] == "planned", (name, info)
env = ms_highway.drive(gymnasium.make("intersection-v0"))
env.reset(seed=0)
for _ in range(2):
    env.step(env.action_space.sample())
config = {"action": {"type": "ContinuousAction"}}
functions = ms_highway.FunctionalEnv("merger-v0", config)

def step(state, action):
    state, _, reward, *_ = functions.step(state, action)
    return state, reward

def rollout(key):
    actions = jax.random.uniform(key, (3, 2), minval=-1, maxval=1)
    return jax.lax.scan(step, functions.reset(key)[0], actions)

keys = jax.random.split(jax.random.key(0), 2)
_, rewards = jax.jit(jax.vmap(rollout))(keys)
assert rewards.dtype == "float32"
assert main("sweep merger --controllers tom --seeds 2 --out out".split()) == 0
"""


@pytest.mark.slow
def test_single_precision_holds_in_a_program_of_double_precision(tmp_path):
    python(
        "-c", DOUBLE_PRECISION, cwd=tmp_path, env={**os.environ, "JAX_ENABLE_X64": "1"}
    )
