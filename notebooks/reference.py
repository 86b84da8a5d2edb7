"""Write REFERENCE.md beside this file: what each environment observes, does, rewards
and tells, from its classes.

python notebooks/reference.py
"""

import ast
import inspect
import re
from itertools import pairwise
from pathlib import Path

import gymnasium as gym
from highway_env.envs.common.abstract import AbstractEnv

from ms_highway.envs import ENVIRONMENTS, environment_id
from ms_highway.envs.info import GameInfo, InteractionInfo, PlanInfo
from ms_highway.envs.settings import Settings
from ms_highway.game import scenarios
from ms_highway.game.scenario import Scenario


def plain(text: str) -> str:
    """Return a text of the source as a cell of a table."""
    return re.sub(r"\s+", " ", text).strip().replace("``", "`").replace("|", "/")


def texts_behind(source: str) -> dict[str, str]:
    """Return the texts behind the assignments of a module or a class, by name."""
    tree = ast.parse(source)
    body = tree.body
    if isinstance(body[0], ast.ClassDef):
        body = body[0].body
    texts = {}
    for statement, behind in pairwise(body):
        names = [statement.target] if isinstance(statement, ast.AnnAssign) else []
        if isinstance(statement, ast.Assign):
            names = statement.targets
        match behind:
            case ast.Expr(value=ast.Constant(value=str(text))):
                texts |= {name.id: plain(text) for name in names}
    return texts


def first_sentence(text: str) -> str:
    """Return the first sentence of a text, without its full stop."""
    return re.split(r"(?<=[a-z`)\]])\. ", text)[0].rstrip(".")


INFO = {
    key: text
    for record in (GameInfo, PlanInfo, InteractionInfo)
    for key, text in texts_behind(inspect.getsource(record)).items()
}
"""What each key of `info` says, from its record."""

CONFIGURATION = {"action": "Who drives, see [Actions](#actions)."}
CONFIGURATION |= texts_behind(inspect.getsource(Settings))
"""What each key of the configuration says, from its settings."""

OF_HIGHWAY_ENV = [key for key in AbstractEnv.default_config() if key != "action"]

PAGE = """# Environments

Written by `python notebooks/reference.py` from the classes. All lengths are in metres, times in seconds, angles in radians; x
is along the road, y to the right. [Words](MAP.md#words) are in the guide.

```python
# one environment
env = gym.make("ms-highway/merger-v1", config={{...}})
# many, in JAX; no films
envs = gym.make_vec("ms-highway/merger-v1", num_envs=1024, config={{...}})
```

## Actions

| `config["action"]["type"]` | space | the agent |
| --- | --- | --- |
| `Autopilot` (default) | Discrete(1) | lets `config["controller"]` drive |
| `HumanModelAction` | Discrete(models), or MultiDiscrete of every human | chooses models by their place in `config["ladder"]`; pays `lambda` T(M) for the time of a plan. The price must be given: `{{"type": "HumanModelAction", "lambda": 1.0}}` |
| `ContinuousAction` | Box(-1, 1, 2) | accelerates by +-5 m/s², steers front wheels by +-0.1 rad, at speeds from 0 to 40 m/s; other ranges by `acceleration_range`, `steering_range`, `speed_range` |
| `DiscreteAction` | Discrete | the same, in `actions_per_axis` steps |

The executed `info["control"]` may exceed the default ranges of actions. Divided by the ends of wider ranges, such as
`ms_highway.envs.demonstration.ACTION`, it is the `ContinuousAction` that does the same within `speed_range`.

## Observations

`[cars, columns]`: the robot, then all humans, then scripted cars. Other types are highway-env's own.

{}

## Environments

{}

An episode ends after its steps (truncated), or with `terminate_on_collision` at a collision (terminated).

Every human plans for its own reward and believes that all other cars, the robot included, keep their velocity. Among several
humans, rewards are drawn for every episode, so that some yield more readily than others. There, the robot succeeds if it ends in
the target lane and never collides.

## Reward

The robot's own, the sum of weighted features after the step; less `lambda` T(M) under `HumanModelAction`. `info["rewards"]`
has its terms; `ms_highway.game.features.features` defines them, `ms_highway.game.scenarios` has their weights. A collision only
costs reward, as in the paper: cars neither push each other nor stop.

In version 1, a collision is an overlap of bodies: cars are rectangles of 5 by 2.5 m, cones are circles 1.87 m across, and
`collision` and `crashed` are the same. In version 0 it is the paper's indicator, which tests nine points of the robot against
ellipses within the other cars and cones. It misses overlapping corners, and most of a cone at the car's side. `crashed` counts
these.

## `info`

{}

Every key is there from the reset on, with one type and shape, so that recorders such as Minari's can store it. Before the first step,
texts are empty, and times and terms are 0. What belongs to a plan (`model` to `counted_seconds`) is there where the robot plans. Vector
environments tell `collision`, `status`, `model`, `counted_seconds` and, among several humans, `success`, with masks.

## In JAX

`gym.make_vec` and `ms_highway.FunctionalEnv` simulate the same episodes in JAX. `FunctionalEnv` has pure functions of a state, which does not
reset itself: after its last step, start again. They compile for a minute or two; with `ContinuousAction`, which plans nothing for the robot,
for less. A rollout of 8 environments:

```python
import jax
import ms_highway

env = ms_highway.FunctionalEnv("merger-v1", {{"action": {{"type": "ContinuousAction"}}}})


def rollout(key):
    def step(state, key):
        action = jax.random.uniform(key, env.action_space.shape, minval=-1, maxval=1)
        state, _, reward, *_ = env.step(state, action)
        return state, reward

    start, actions = jax.random.split(key)
    state, observation = env.reset(start)
    return jax.lax.scan(step, state, jax.random.split(actions, 40))[1]


rewards = jax.jit(jax.vmap(rollout))(jax.random.split(jax.random.key(0), 8))  # [8, 40]
```

They compute in single precision, also under `JAX_ENABLE_X64=1`. They have derivatives in forward mode, `jax.jvp` and `jax.jacfwd`. JAX
refuses reverse mode, `jax.grad`, where plans are loops that end when they have converged: with other solvers than `gradient`, such as those
of version 1.

Single environments and these differ by rounding: they are other programs of the same equations, in single precision. In the first three
steps, states agree within 0.02 (m, rad, m/s). Chaotic scenes amplify the difference. In `stay-back-v1` with `learned:1`, seeds 7 and 8, the
vector environment chooses other models from the thirteenth step on; within 25 steps, states differ by up to 0.9, and the reward of a step by
up to 0.04. Chaos does this, not the batch: a start moved by a micrometre changes single environments of seeds 7 to 10 by up to 2.0 in as
many steps, and the reward of a step by up to 0.13. So compare means over many episodes there, not single ones.

`ms_highway.plan` compiles and times by itself, and returns NumPy; the function to trace is
`ms_highway.planning.compiled_plans.plan_for`, whose controls are scaled.

## Configuration

Unknown keys are refused; nested ones merge. highway-env's own keys for pictures apply, too. A default that is not named is the
scenario's. Changes act from the next reset on, and `config` describes the current episode until then. Before the first reset and
after the end of an episode, `configure` changes `config` and spaces at once.

{}

## `reset`

`options={{"config": ...}}` changes the configuration. `options={{"initial_states": ...}}` gives the starts instead of drawn ones: an
array [cars, 4] of x, y, heading and speed in SI units, of the robot, the humans and the scripted cars in this order. Whole turns
of a heading are left out.
"""


def observation_rows() -> list[str]:
    rows = ["| type | columns | bounds |", "| --- | --- | --- |"]
    for kind in ("SceneStates", "CarStates"):
        env = gym.make(
            "ms-highway/merger-v1", config={"observation": {"type": kind}}
        ).unwrapped
        text = re.sub(r"\s+", " ", inspect.getdoc(type(env.observation_type))).replace(
            "``", "`"
        )
        high = ", ".join(f"{value:g}" for value in env.observation_space.high[0])
        rows.append(f"| `{kind}` | {text} | in Merger v1, up to {high} |")
    return rows


def scenes() -> dict[str, str]:
    """Return the first sentence about each of the package's scenarios, by name."""
    texts = texts_behind(inspect.getsource(scenarios))
    return {
        scenario.name: first_sentence(texts[variable])
        for variable, scenario in vars(scenarios).items()
        if isinstance(scenario, Scenario)
    }


def environment_rows() -> list[str]:
    rows = [
        "| id | scene | observes | steps | models to choose from | costs |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    about = scenes()
    for name, kind in ENVIRONMENTS.items():
        config = kind.default_config()
        shape = gym.make(environment_id(name)).observation_space.shape
        cells = (
            f"`{environment_id(name).partition(':')[2]}`",
            about[name],
            f"{config['observation']['type']} {list(shape)}",
            str(round(config["duration"] / config["time_step"])),
            ", ".join(config["ladder"]),
            config["costs"],
        )
        rows.append(f"| {' | '.join(cells)} |")
    return rows


def configuration_keys() -> list[str]:
    """Return the keys that are explained, in the order of the configuration."""
    config = ENVIRONMENTS["merger-v1"].default_config()
    return [key for key in config if key in CONFIGURATION]


def configuration_rows() -> list[str]:
    config = ENVIRONMENTS["merger-v1"].default_config()
    rows = ["| key | default of Merger v1 | meaning |", "| --- | --- | --- |"]
    rows += [
        f"| `{key}` | `{config[key]!r}` | {CONFIGURATION[key]} |"
        for key in configuration_keys()
    ]
    return rows


def page() -> str:
    """Return the text of the page."""
    info = [f"| `{key}` | {text} |" for key, text in INFO.items()]
    tables = (
        observation_rows(),
        environment_rows(),
        ["| key | meaning |", "| --- | --- |", *info],
        configuration_rows(),
    )
    return PAGE.format(*("\n".join(rows) for rows in tables))


if __name__ == "__main__":
    Path(__file__).with_name("REFERENCE.md").write_text(page())
