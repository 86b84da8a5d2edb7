"""Write REFERENCE.md beside this file: what each environment observes, does, rewards and tells, from its classes.

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
    "crashed": "whether the robot has touched another car in this step",
    "collision": "whether it collides by the reward's measure, which counts cones, too",
    "collision_effect": "what a collision does: it only costs reward",
    "control": "what the robot did: `acceleration` before friction [m/s²], `steering` of the front wheels [rad]",
    "action": "that was given",
    "rewards": "terms of the reward by feature; `computation` is -lambda T where the agent chooses models",
    "model": "the most expensive model in the plan that is followed",
    "models": "name of every human's model in it",
    "status": "`planned`, `previous plan`, `braking`, `late` or `way out`: where the control comes from",
    "choice_failed": "whether the models could not be chosen",
    "timing": "`planning_seconds`, `decision_seconds`, `compile_seconds` of the step [s]",
    "clocked": "whether measured times had a say in the choice, so that the same seed may be another episode",
    "gains": "highest estimated gain of each model over all humans [reward], by which the choice is made",
    "counted_seconds": "T of the step's own plan [s]",
    "human_status": "a status for each human; None for cars that do not plan",
    "distance_to_cones": "from the robot's front to the first cone ahead in its lane, infinite without one [m]",
    "success": "whether the robot is in the target lane and has not collided so far",
    "is_success": "the same, as stable-baselines3 calls it",
    "humans_idm": "number of humans predicted by the model; likewise `humans_turn` and `humans_tom`",
    "belief": "with a controller's `belief`: probability of naive, idm, turn and tom for every human, [humans, 4]",
}
"""What is in `info`, and its unit."""

OF_HIGHWAY_ENV = [key for key in AbstractEnv.default_config() if key != "action"]

PAGE = """# Environments

Written by `python notebooks/reference.py` from the classes; `help(ms_highway.InteractionEnv)` says more. All lengths are in
metres, times in seconds, angles in radians; x is along the road, y to the right.

```python
env = gym.make("ms-highway/merger-v1", config={{...}})  # one environment
envs = gym.make_vec("ms-highway/merger-v1", num_envs=1024, config={{...}})  # many, in JAX; no films
functions = ms_highway.FunctionalEnv("merger-v1", {{...}})  # reset(key), step(state, action), to jit
```

## Actions

| `config["action"]["type"]` | space | the agent |
| --- | --- | --- |
| `Autopilot` (default) | Discrete(1) | lets `config["controller"]` drive |
| `HumanModelAction` | Discrete(models), or MultiDiscrete of every human | chooses models by their place in `config["ladder"]`; pays `lambda` T |
| `ContinuousAction` | Box(-1, 1, 2) | accelerates by +-5 m/s², steers front wheels by +-0.1 rad; other ranges by `acceleration_range`, `steering_range` |
| `DiscreteAction` | Discrete | the same, in `actions_per_axis` steps |

## Observations

`[cars, columns]`: the robot, then all humans, then scripted cars. Other types are highway-env's own.

{}

## Environments

{}

An episode ends after its steps (truncated), or with `terminate_on_collision` at a collision (terminated).

## Reward

The robot's own, the sum of weighted features after the step; less `lambda` T under `HumanModelAction`. `info["rewards"]`
has its terms.

## `info`

{}

Vector environments tell `collision`, `status`, `model`, `counted_seconds` and `success`, with masks.

## Configuration

Unknown keys are refused; nested ones merge. highway-env's own keys for pictures apply, too.

{}
"""  # noqa: E501


def first_sentence(text: str) -> str:
    """Return the first sentence of a text."""
    return re.split(r"(?<=[a-z`)\]])\. ", re.sub(r"\s+", " ", text).replace("``", "`"))[0].rstrip(".;")


def meanings() -> dict[str, str]:
    """Return what the documentation of `InteractionEnv` says of each configuration key, in short."""
    items = re.split(r"\n\* ", inspect.getdoc(ms_highway.InteractionEnv).partition("\n\n``reset`` takes")[0])[1:]
    found = {}
    for item in items:
        names, _, text = item.partition(": ")
        found |= dict.fromkeys(re.findall(r"``(\w+)``", names), first_sentence(text))
    found["duration"], _, found["terminate_on_collision"] = found["duration"].partition("; `terminate_on_collision`: ")
    return found


def observation_rows() -> list[str]:
    rows = ["| type | columns | bounds |", "| --- | --- | --- |"]
    for kind in ("SceneStates", "CarStates"):
        env = gym.make("ms-highway/merger-v1", config={"observation": {"type": kind}}).unwrapped
        text = re.sub(r"\s+", " ", inspect.getdoc(type(env.observation_type))).replace("``", "`")
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
        cells = f"`{environment_id(name).partition(':')[2]}`", about, observed, steps, ", ".join(config["ladder"])
        rows.append(f"| {' | '.join(map(str, cells))} | {config['costs']} |")
    return rows


def configuration_keys() -> list[str]:
    """Return the keys that the documentation explains, in the order of the configuration."""
    told = meanings()
    return [key for key in ENVIRONMENTS["merger-v1"].default_config() if key in told]


def configuration_rows() -> list[str]:
    told, base = meanings(), ENVIRONMENTS["merger-v1"].default_config()
    rows = ["| key | default of Merger v1 | what it says |", "| --- | --- | --- |"]
    return rows + [f"| `{key}` | `{base[key]!r}` | {told[key].replace('|', '/')} |" for key in configuration_keys()]


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
