"""Know human models by name, and make ladders of them.

A model's name may have an effort: ``tom@8`` is theory of mind in 8 ascent steps,
``tom+warm`` starts from the rest of the last plan, and ``tom@8+warm`` does both.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from math import inf

from ms_highway.numerics.solvers import GRADIENT_STEPS
from ms_highway.planning.human_models import PACKAGE_TYPES, HumanModel
from ms_highway.runtime.definitions import note_definition
from ms_highway.runtime.names import check_own_name, keep_apart

BEST = "best"
"""Name of `BEST_LADDER` in configurations and commands."""

BEST_LADDER = ("naive@4+warm", "tom@6+warm", "tom@12+warm")
"""Ladder of the rungs that earn most for their time.

Reward per step in Merger and Give Way, each rung alone, with 30 starts, the learned
human and paper semantics: 4.67 and -0.04 at 5 % of tom's T, 6.40 and 5.27 at 30 %, 6.52
and 5.77 at 60 %. Tom earns 6.25 and 5.02, turn 1.51 and 0.09 at 46 %, naive 1.50 and
0.03 at 24 %. In Stay Back, where outcomes are chaotic, the upper two rungs are not
worth their time: the three earn 0.98, 0.14 and -2.99; naive earns 0.60, turn 1.50, tom
1.65, and naive@10 most, 1.90.
"""

MODELS: dict[str, HumanModel] = {model.name: model() for model in PACKAGE_TYPES}
"""Known models by name, cheapest first."""

PACKAGE_MODELS = tuple(MODELS)
"""Names of the package's models, cheapest first, for pairs, several humans and roads.
"""

PAPER_MODELS = ("naive", "turn", "tom")
"""Names of the paper's models, cheapest first."""

keep_apart("a human model", lambda: MODELS)


def register(model: HumanModel, before: str | None = None) -> None:
    """Register a human model by its name.

    Configurations and commands of this process then know it.

    Args:
        model: hashable; replaces a model of the same name.
        before: name of the next more expensive model on ladders; by default, the new
            model is the most expensive.

    Raises:
        ValueError: if the name is the package's, that of a controller, a driver or an
            agent, or no word, or ``before`` names no other model; if the model is no
            `HumanModel`, or not hashable.
    """
    _check_model(model)
    check_own_name("a human model", model.name, lower=False)
    names = [name for name in MODELS if name != model.name]
    if before is not None and before not in names:
        raise ValueError(
            f"unknown human model {before!r} to come before; the models are"
            f" {', '.join(names)}"
        )
    place = len(names) if before is None else names.index(before)
    names.insert(place, model.name)
    known = MODELS | {model.name: model}
    MODELS.clear()  # not replaced, as other modules hold it
    MODELS.update((name, known[name]) for name in names)
    note_definition(model.name, model)


def _check_model(model: HumanModel) -> None:
    """Check that a user's model is one that plans can use.

    Raises:
        ValueError: naming the problem and its remedy.
    """
    own_name = getattr(type(model), "name", None)
    if not isinstance(model, HumanModel) or own_name != model.name:
        remedy = (
            "make it a frozen dataclass derived from ms_highway.HumanModel, whose class"
            " has a name"
        )
        raise ValueError(f"{model!r} is no model; {remedy}")
    problem = _problem_of_methods(model)
    if problem is not None:
        raise ValueError(f"human model {model.name!r} {problem}")
    try:
        hash(model)
    except TypeError as error:
        raise ValueError(
            f"{model!r} cannot be compiled for: {error}; make it a frozen dataclass"
        ) from None


def _problem_of_methods(model: HumanModel) -> str | None:
    """Return what is wrong with the methods that a model defines, and the remedy."""
    predicts = type(model).predict is not HumanModel.predict
    starts = type(model).start is not HumanModel.start
    if hasattr(model, "plan"):
        return (
            "defines `plan`, which plans among several humans cannot obey; define its"
            " own steps by `solver` and their start by `start`, or define `predict`"
        )
    if not model.responds and not predicts:
        return (
            "neither predicts nor responds; define `predict`, or set the class's"
            " ``responds`` to True"
        )
    if model.responds and predicts:
        return (
            "responds, and defines `predict`; a human that responds is not predicted;"
            " leave it out, or set the class's ``responds`` to False"
        )
    if not model.responds and starts:
        return (
            "does not respond, and defines `start`; only models that respond have a"
            " start of their own; leave it out"
        )
    return None


def human_model(name: str) -> HumanModel:
    """Return the model of a name, with its effort, such as ``tom@8+warm``.

    Raises:
        ValueError: if it is no model's name.
    """
    pattern = r"(?P<model>[^@+]+)(@(?P<steps>[1-9][0-9]{0,8}))?(?P<warm>\+warm)?"
    parts = re.fullmatch(pattern, name) if isinstance(name, str) else None
    steps = int(parts["steps"] or 0) if parts else 0
    if (
        parts is None
        or parts["model"] not in MODELS
        or steps > GRADIENT_STEPS.max_number
    ):
        raise ValueError(
            f"unknown human model {name!r}; the models are {model_names()}"
        )
    model = MODELS[parts["model"]]
    return replace(model, steps=steps or None, warm=bool(parts["warm"]))


def is_model(name: object) -> bool:
    """Return whether a value names a human model, with or without an effort."""
    try:
        return bool(human_model(name))  # type: ignore[arg-type]
    except ValueError:
        return False


def model_names() -> str:
    """Return the names of all models, for messages."""
    most = GRADIENT_STEPS.max_number
    return (
        f"{', '.join(MODELS)}, also in 1 to {most} steps (tom@8) or from the last plan"
        " (tom@8+warm)"
    )


def known_models(used: Iterable[str]) -> list[str]:
    """Return the names of all known models and of those in use, cheapest first.

    Those in use have their efforts.
    """
    names = {*MODELS, *filter(is_model, used)}
    return sorted(names, key=lambda name: _rank(human_model(name)))


def cheapest_first(used: Iterable[str]) -> list[str]:
    """Return the names of the models in use, each once, cheapest first.

    Names that are not registered come last.
    """
    used = {name for name in used if name}
    known = [name for name in known_models(used) if name in used]
    return known + sorted(used - {*known})


def _rank(model: HumanModel) -> tuple[int, float, bool]:
    """Return the key by which models are sorted.

    It is the type, then the number of steps, the planner's own number last.
    """
    place_of_type = list(MODELS).index(type(model).name)
    steps = model.steps or inf
    return place_of_type, steps, model.warm


def rung_names(names: Sequence[str]) -> list[str]:
    """Return the names of a ladder's rungs, for ``best`` those of `BEST_LADDER`."""
    is_best = names == BEST or list(names) == [BEST]
    return list(BEST_LADDER if is_best else names)


def ladder(names: Sequence[str]) -> tuple[HumanModel, ...]:
    """Return the models of these names, or of `BEST_LADDER` by its name, ``best``.

    Rungs are ordered by model and, for the same model, by number of steps, the
    planner's own number last. Costs do not matter, as they differ between machines.

    Raises:
        ValueError: unless all are known, and each is named once, cheapest first; if
            there is none.
    """
    rungs = tuple(human_model(name) for name in rung_names(names))
    ranks = [_rank(rung) for rung in rungs]
    if not ranks or ranks != sorted(set(ranks)):
        order = f"out of {list(MODELS)}, and of the same model fewer steps first"
        raise ValueError(
            f"impossible ladder {list(names)}: name each model once, cheapest first,"
            f" {order}"
        )
    return rungs
