"""Write REFERENCE.md beside this file: what each environment observes, does, rewards
and tells, from its classes.

python notebooks/reference.py
"""

import inspect
import re
from pathlib import Path

import gymnasium as gym
from highway_env.envs.common.abstract import AbstractEnv

import ms_highway
from ms_highway.envs import ENVIRONMENTS, environment_id

INFO = {
    "speed": "of the robot [m/s]",
    "crashed": "whether the robot's body overlaps another one after this step",
    "collision": "whether it collides by the reward's measure, see [Reward](#reward)",
    "collision_effect": "what a collision does: it only costs reward",
    "control": (
        "what the robot did: `acceleration` before friction [m/s²], `steering` of the"
        " front wheels [rad]"
    ),
    "action": "that was given; NaN or -1 before the first step",
    "rewards": (
        "terms of the reward by feature; `computation` is -lambda T where the agent"
        " chooses models"
    ),
    "model": (
        "the model that predicts the human in the plan that drives; of several humans,"
        " their most expensive one"
    ),
    "models": "name of every human's model in it",
    "status": (
        "what drives: the step's plan (`planned`); the `previous plan`, where that"
        " failed; `braking`, where both did; the previous plan again, as the new one"
        " came `late`; or a `way out` from humans who do not yield"
    ),
    "choice_failed": "whether a gain that the rule asked for could not be computed",
    "plan_steps": (
        "number of steps of the ascent that led to this step's plan; 0 if nothing was"
        " planned"
    ),
    "converged": "whether the last of these steps hardly moved the plan",
    "timing": (
        "`planning_seconds`, `decision_seconds`, `compile_seconds` of the step [s]"
    ),
    "clocked": (
        "whether measured times had a say in the choice, so that the same seed may be"
        " another episode"
    ),
    "gains": (
        "gain per step that the controller expects of each model over the first of the"
        " ladder, before the price of its time [reward]; the highest over the humans"
        " for whom it is estimated; of every model of the ladder, -inf where none was"
        " estimated; empty where no rule chooses"
    ),
    "counted_seconds": "T of the step's plan [s]",
    "human_status": "a status for each human; None for cars that do not plan",
    "distance_to_cones": (
        "from the robot's front to the first cone ahead in its lane, infinite without"
        " one [m]"
    ),
    "success": (
        "among several humans: whether the robot is in the target lane and has not"
        " collided so far"
    ),
    "is_success": "the same, as stable-baselines3 calls it",
    "humans_idm": (
        "among several humans: number predicted by this model; likewise `humans_turn`"
        " and `humans_tom`"
    ),
    "belief": (
        "with a controller's `belief`: probability of naive, idm, turn and tom for"
        " every human, [humans, 4]"
    ),
}
"""What is in `info`, and its unit."""

OF_HIGHWAY_ENV = [key for key in AbstractEnv.default_config() if key != "action"]

PAGE = """# Environments

Written by `python notebooks/reference.py` from the classes; `help(ms_highway.InteractionEnv)` says more. All lengths are in
metres, times in seconds, angles in radians; x is along the road, y to the right. [Words](MAP.md#words) are in the guide.

```python
env = gym.make("ms-highway/merger-v1", config={{...}})  # one environment
envs = gym.make_vec("ms-highway/merger-v1", num_envs=1024, config={{...}})  # many, in JAX; no films
```

## Actions

| `config["action"]["type"]` | space | the agent |
| --- | --- | --- |
| `Autopilot` (default) | Discrete(1) | lets `config["controller"]` drive |
| `HumanModelAction` | Discrete(models), or MultiDiscrete of every human | chooses models by their place in `config["ladder"]`; pays `lambda` T(M) for the time of a plan. The price must be given: `{{"type": "HumanModelAction", "lambda": 1.0}}` |
| `ContinuousAction` | Box(-1, 1, 2) | accelerates by +-5 m/s², steers front wheels by +-0.1 rad; other ranges by `acceleration_range`, `steering_range` |
| `DiscreteAction` | Discrete | the same, in `actions_per_axis` steps |

## Observations

`[cars, columns]`: the robot, then all humans, then scripted cars. Other types are highway-env's own.

{}

## Environments

{}

An episode ends after its steps (truncated), or with `terminate_on_collision` at a collision (terminated).

## Reward

The robot's own, the sum of weighted features after the step; less `lambda` T(M) under `HumanModelAction`. `info["rewards"]`
has its terms; `ms_highway.game.features.features` defines them, `ms_highway.game.scenarios` has their weights.

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
        state, observation, reward, terminated, truncated, info = env.step(state, action)
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

Unknown keys are refused; nested ones merge. highway-env's own keys for pictures apply, too.

{}
"""


def first_sentence(text: str) -> str:
    """Return the first sentence of a text."""
    return re.split(r"(?<=[a-z`)\]])\. ", re.sub(r"\s+", " ", text).replace("``", "`"))[
        0
    ].rstrip(".;")


def meanings() -> dict[str, str]:
    """Return what the documentation of `InteractionEnv` says of each configuration key,
    in short.
    """
    items = re.split(
        r"\n\* ",
        inspect.getdoc(ms_highway.InteractionEnv).partition("\n\n``reset`` takes")[0],
    )[1:]
    found = {}
    for item in items:
        names, _, text = item.partition(": ")
        found |= dict.fromkeys(re.findall(r"``(\w+)``", names), first_sentence(text))
    found["duration"], _, found["terminate_on_collision"] = found["duration"].partition(
        "; `terminate_on_collision`: "
    )
    return found


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


def environment_rows() -> list[str]:
    rows = [
        "| id | scene | observes | steps | models to choose from | costs |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for name, kind in ENVIRONMENTS.items():
        config = kind.default_config()
        steps = round(config["duration"] / config["time_step"])
        shape = gym.make(environment_id(name)).observation_space.shape
        observed = f"{config['observation']['type']} {list(shape)}"
        about = re.sub(r"\s+", " ", inspect.getdoc(kind)).split(". ")[0].rstrip(".")
        cells = (
            f"`{environment_id(name).partition(':')[2]}`",
            about,
            observed,
            steps,
            ", ".join(config["ladder"]),
        )
        rows.append(f"| {' | '.join(map(str, cells))} | {config['costs']} |")
    return rows


def configuration_keys() -> list[str]:
    """Return the keys that the documentation explains, in the order of the
    configuration.
    """
    told = meanings()
    return [key for key in ENVIRONMENTS["merger-v1"].default_config() if key in told]


def configuration_rows() -> list[str]:
    told = meanings()
    base = ENVIRONMENTS["merger-v1"].default_config()
    rows = ["| key | default of Merger v1 | what it says |", "| --- | --- | --- |"]
    return rows + [
        f"| `{key}` | `{base[key]!r}` | {told[key].replace('|', '/')} |"
        for key in configuration_keys()
    ]


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
