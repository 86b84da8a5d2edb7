"""Run a scene while the annotations of all functions of the package are checked.

``python typechecked.py SCENE`` fails at the first argument or result that is not of the
type, or not of the shape, that its annotation tells.
"""

import sys
from collections.abc import Callable
from tempfile import TemporaryDirectory
from typing import Any

import gymnasium as gym
import jaxtyping
import numpy as np
from beartype import BeartypeConf, beartype
from beartype.roar import BeartypeDecorHintException

INTEGERS_ARE_NUMBERS = BeartypeConf(is_pep484_tower=True)


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Let beartype check the annotations of a function that it can check.

    It cannot check `typing.Self`, protocols that are not for `isinstance`, and generic
    named tuples.
    """
    hints = function.__annotations__.items()
    function.__annotations__ = {
        name: hint for name, hint in hints if is_checkable(hint)
    }
    return beartype(conf=INTEGERS_ARE_NUMBERS)(function)


def is_checkable(hint: Any) -> bool:
    def probe(value: Any) -> None:
        """Take a value of this type."""

    probe.__annotations__ = {"value": hint}
    try:
        beartype(conf=INTEGERS_ARE_NUMBERS)(probe)
    except BeartypeDecorHintException:
        return False
    return True


def watch() -> None:
    """Let all functions of the package that are imported later be checked.

    Records are not checked when they are made: JAX makes them of batches, of axes and
    of whatever else it maps over their fields.
    """
    jaxtyped = jaxtyping.jaxtyped

    def only_functions(*, typechecker: Any) -> Callable[[Any], Any]:
        decorate = jaxtyped(typechecker=typechecker)
        return lambda defined: (
            defined if isinstance(defined, type) else decorate(defined)
        )

    jaxtyping.jaxtyped = only_functions
    jaxtyping.install_import_hook("ms_highway", "typechecked.checked")


def episode(environment: str, controller: str, steps: int = 2, **config: Any) -> None:
    """Reset an environment of the package, and let its robot decide, plan and drive."""
    from ms_highway.envs.registry import controller_config

    env = gym.make(
        f"ms-highway/{environment}",
        config={"controller": controller_config(controller), **config},
    )
    env.reset(seed=0)
    for _ in range(steps):
        env.step(env.action_space.sample())
    env.close()


def game() -> None:
    """One human: Algorithm 1 in the paper's version."""
    episode("merger-v0", "switching:0.1")


def physical() -> None:
    """One human within tyres, learned values, and a belief over models."""
    episode("give-way-v1", "learned:1+belief")


def several() -> None:
    """Several humans, and a budget."""
    small = {"humans": 2, "costs": "published"}
    episode("dense-merge-v1", "budget:60", **small)


def stock() -> None:
    """A stock road of highway-env, on which others change lanes and respond."""
    import ms_highway

    env = ms_highway.drive(gym.make("highway-fast-v0"))
    env.reset(seed=0)
    for _ in range(2):
        env.step(env.action_space.sample())


def batch() -> None:
    """Two episodes at once, on one device."""
    from ms_highway.cli.main import main

    with TemporaryDirectory() as out:
        options = f"--controllers tom switching:0.1 --seeds 2 --devices 1 --out {out}"
        assert main(["sweep", "merger", *options.split()]) == 0


def prediction() -> None:
    """Predict where recorded drivers will be."""
    import ms_highway

    past = np.zeros((11, 3, 4))
    past[..., 0] = np.arange(11.0)[:, None] + [0.0, 20.0, 40.0]
    past[..., 3] = 10.0
    ms_highway.predict(past, [0.0, 4.0], 20.0)


SCENES = {
    scene.__name__: scene
    for scene in (game, physical, several, stock, batch, prediction)
}


def check_watch() -> None:
    """Check that a wrong type, and a wrong shape, are found."""
    from ms_highway.game.dynamics import without_turns
    from ms_highway.runtime.files import file_name

    for function, wrong in ((file_name, 1), (without_turns, "no array")):
        try:
            function(wrong)
        except jaxtyping.TypeCheckError:
            continue
        sys.exit(
            f"{function.__qualname__} takes {wrong!r}: annotations are not checked"
        )


if __name__ == "__main__":
    watch()
    check_watch()
    SCENES[sys.argv[1]]()
