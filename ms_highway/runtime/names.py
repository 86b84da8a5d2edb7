"""List names of the package, and keep names apart: a name of a user's means one thing,
whatever was added first.
"""

import re
from collections.abc import Callable, Iterable
from itertools import chain

SCENARIO_NAMES = (
    "stay_back",
    "merger",
    "give_way",
    "dense_merge",
    "crossing_crowd",
    "stay-back-v1",
    "merger-v1",
    "give-way-v1",
    "dense-merge-v1",
    "crossing-crowd-v1",
)
"""Names of the package's scenarios, for ids and help texts, which load no JAX."""

VERSIONED = re.compile(r".*-v\d+")
"""Names of scenarios that end in a version; the other scenarios are at version 0."""

PACKAGE_NAMES: dict[str, tuple[str, ...]] = {
    "a human model": ("naive", "idm", "turn", "tom", "best"),
    "a rule": (
        *("switching", "horizon", "learned", "budget", "nearest"),
        *("driver", "agent", "fixed", "schedule", "random"),
    ),
    "a human driver": ("never", "always", "keyboard", "usual", "mixed"),
    "an agent": (),
    "a driver of roads": ("priced", "human"),
}
"""Names of the package, by kind. They are repeated here because a user may add a name
before its module is loaded.
"""

_ADDED: dict[str, Callable[[], Iterable[str]]] = {}


def versioned(scenario: str) -> str:
    """Return the last part of a scenario's id: ``merger-v0`` for ``merger``."""
    return (
        scenario
        if VERSIONED.fullmatch(scenario)
        else f"{scenario.replace('_', '-')}-v0"
    )


def environment_class_name(scenario: str) -> str:
    """Return the name of the class of a scenario's environments: ``MergerV1Env`` for
    ``merger-v1``.
    """
    words = re.split("[_-]", scenario)
    return f"{''.join(map(str.capitalize, words))}Env"


def keep_apart(what: str, names: Callable[[], Iterable[str]]) -> None:
    """Let the names that a function returns be refused for anything else than ``what``,
    a key of `PACKAGE_NAMES`.
    """
    _ADDED[what] = names


def check_own_name(what: str, name: object, lower: bool = True) -> None:
    """Check a name for something that a user adds; it may replace a user's of the same
    kind.

    Args:
        what: a key of `PACKAGE_NAMES`.
        name: to be checked.
        lower: whether it must be in lower case.

    Raises:
        ValueError: if the package or something else has the name, or if it is not one
            word.
    """
    others = (names() for other, names in _ADDED.items() if other != what)
    check_name(what, name, chain(*PACKAGE_NAMES.values(), *others), lower)


def check_name(
    what: str,
    name: object,
    taken: Iterable[str],
    lower: bool = True,
) -> None:
    """Refuse a name that is taken, or that is not one word, in lower case if wanted.

    Raises:
        ValueError: for such a name.
    """
    taken = dict.fromkeys(taken)
    word = (
        isinstance(name, str) and name.isidentifier() and (name.islower() or not lower)
    )
    if not word or name in taken:
        remedy = (
            f"choose one word{' in lower case' * lower} other than {', '.join(taken)}"
        )
        raise ValueError(f"{what} cannot be called {name!r}; {remedy}")
