"""List names of the package, and keep a user's names apart from others.

A name means one thing, whatever was added first.
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

# Functions that return the names that a user has added, by kind.
_added_names: dict[str, Callable[[], Iterable[str]]] = {}


def has_version(scenario: str) -> bool:
    """Return whether a scenario's name ends in a version; others are at version 0."""
    return re.fullmatch(r".*-v\d+", scenario) is not None


def versioned(scenario: str) -> str:
    """Return the last part of a scenario's id: ``merger-v0`` for ``merger``."""
    if has_version(scenario):
        return scenario
    return f"{scenario.replace('_', '-')}-v0"


def environment_class_name(scenario: str) -> str:
    """Return the class name of a scenario's environments.

    This is ``MergerV1Env`` for ``merger-v1``.
    """
    words = [word.capitalize() for word in re.split("[_-]", scenario)]
    return f"{''.join(words)}Env"


def keep_apart(what: str, names: Callable[[], Iterable[str]]) -> None:
    """Let names be refused for anything of another kind.

    Args:
        what: kind of what has these names, a key of `PACKAGE_NAMES`.
        names: returns the names.
    """
    _added_names[what] = names


def check_own_name(what: str, name: object, lower: bool = True) -> None:
    """Check a name for something that a user adds.

    It may replace something of the user's of the same kind.

    Args:
        what: a key of `PACKAGE_NAMES`.
        name: to be checked.
        lower: whether it must be in lower case.

    Raises:
        ValueError: if the package or something else has the name, or if it is not one
            word.
    """
    taken = list(chain(*PACKAGE_NAMES.values()))
    for kind, names in _added_names.items():
        if kind != what:
            taken.extend(names())
    check_name(what, name, taken, lower)


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
    is_word = isinstance(name, str) and name.isidentifier()
    if lower:
        is_word = is_word and str(name).islower()
    if not is_word or name in taken:
        case = " in lower case" if lower else ""
        remedy = f"choose one word{case} other than {', '.join(taken)}"
        raise ValueError(f"{what} cannot be called {name!r}; {remedy}")
