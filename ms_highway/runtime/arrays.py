"""Name arrays by their shapes, loop over rows, and read structures from JSON.

All types except `SameArray` may be of NumPy or JAX, which a type checker cannot tell
apart.
"""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from reprlib import repr as shortened
from typing import TYPE_CHECKING, Annotated, Any, NewType, NoReturn, TypeAlias, TypeVar

import jax
import msgspec
import numpy as np
from jax import numpy as jnp
from jaxtyping import Bool, Float, Int

Array: TypeAlias = jax.Array | np.ndarray
SameArray = TypeVar("SameArray", jax.Array, np.ndarray, jax.Array | np.ndarray)
"""An array of either kind, returned in the same kind."""

Scalar: TypeAlias = Float[Array, ""] | np.floating | float
Index: TypeAlias = Int[Array, ""] | np.integer | int
Flag: TypeAlias = Bool[Array, ""] | np.bool | bool
Vector: TypeAlias = Float[Array, "n"]
Matrix: TypeAlias = Float[jax.Array, "n n"]
Numeric: TypeAlias = Float[Array, "..."] | np.floating | float
"""An array of numbers, or a single number."""

if TYPE_CHECKING:
    Numbers: TypeAlias = Float[Array, "..."]
else:  # what NumPy computes from arrays without axes are scalars of its own
    Numbers = Float[Array, "..."] | np.floating

Control: TypeAlias = Float[Array, "2"]
Controls: TypeAlias = Float[Array, "steps 2"]
ManyControls: TypeAlias = Float[Array, "*batch steps 2"]
Trajectory: TypeAlias = Float[jax.Array, "fields steps"]
"""Motion of one car over the steps of a plan, the fields of its
`ms_highway.game.dynamics.Motion` stacked.
"""

Car: TypeAlias = Float[Array, "4"]  # x, y [m], heading [rad], speed [m/s]
State: TypeAlias = Float[Array, "cars 4"]  # robot, humans, scripted cars
HumansControl: TypeAlias = Float[Array, "humans 2"]  # omega, acceleration
HumansControls: TypeAlias = Float[Array, "humans steps 2"]
Trajectories: TypeAlias = Float[jax.Array, "cars fields steps"]
Times: TypeAlias = Float[Array, "*times"]

Weights: TypeAlias = Float[Array, "features"]
HumansWeights: TypeAlias = Float[Array, "humans features"]

# A place on the ladder of the robot is not a place in a table of all models.
RungIndex = NewType("RungIndex", int)
"""Place on a ladder of human models, the cheapest first."""

ModelIndex = NewType("ModelIndex", int)
"""Place in a table of all models, such as `ms_highway.planning.ladders.PACKAGE_MODELS`
or `ms_highway.road.traffic_models.TRAFFIC_MODELS`, whatever the ladder in use.
"""

Rungs: TypeAlias = Int[Array, "humans"]
"""`RungIndex` of every human's model."""

ModelNumbers: TypeAlias = Int[Array, "humans"]
"""`ModelIndex` of every human's model."""

Gains: TypeAlias = Float[Array, "humans rungs"]
ModelProbabilities: TypeAlias = Float[Array, "humans models"]
PerHuman: TypeAlias = Float[Array, "humans"]


Tree = TypeVar("Tree")  # a pytree of arrays


def for_rows(function: Callable[..., Tree], *arrays: object) -> Tree:
    """Compute a function of every row of pytrees of arrays.

    A single row needs no `jax.vmap`, so it compiles faster.
    """
    rows = len(jax.tree.leaves(arrays)[0])
    if rows > 1:
        return jax.vmap(function)(*arrays)
    only_row = jax.tree.map(lambda array: array[0], arrays)
    result = function(*only_row)
    return jax.tree.map(lambda array: array[None], result)


def for_numbers(count: int, function: Callable[[Index], Tree]) -> Tree:
    """Compute a function of 0, 1, ..., one by one, and stack the results.

    A single one needs no loop.
    """
    if count == 1:
        return jax.tree.map(lambda array: jnp.asarray(array)[None], function(0))
    return jax.lax.map(function, jnp.arange(count))


def for_each(
    chosen: Bool[Array, "n"],
    function: Callable[[Index, Tree], Tree],
    start: Tree,
) -> Tree:
    """Loop over the chosen rows, one round for each.

    So the time is proportional to their number. Where no row is chosen, nothing is
    computed: without the condition, XLA would compute before the loop whatever is the
    same in all rounds.

    Args:
        chosen: rows to loop over.
        function: takes the index of a row and the result so far, and returns the next
            result.
        start: first result.
    """

    def loop() -> Tree:
        """Compute the function of every chosen row."""
        chosen_first = jnp.argsort(-chosen.astype(int), stable=True)

        def compute(number: Index, result: Tree) -> Tree:
            """Compute the function of one row in the order."""
            return function(chosen_first[number], result)

        return jax.lax.fori_loop(0, jnp.sum(chosen), compute, start)

    return jax.lax.cond(chosen.any(), loop, lambda: start)


def read_only(tree: Tree) -> Tree:
    """Return a pytree with views of its NumPy arrays that cannot be written.

    Functions of a user get such arrays, so that none of them can change a game, a state
    or a record of the package.
    """
    return jax.tree.map(_unwritable, tree)


def _unwritable(leaf: object) -> object:
    """Return a view of a NumPy array that cannot be written; anything else as it is."""
    if not isinstance(leaf, np.ndarray):
        return leaf
    view = leaf.view()
    view.flags.writeable = False
    return view


@contextmanager
def naming_writes(user: str) -> Iterator[None]:
    """Name a function of a user that writes into what `read_only` returned.

    Raises:
        ValueError: in place of NumPy's, which names nothing.
    """
    try:
        yield
    except ValueError as error:
        if "read-only" not in str(error):
            raise
        remedy = "copy an array before you change it, such as state = state.copy()"
        raise ValueError(
            f"{user} writes into an array that it was given; {remedy}"
        ) from error


class Published(dict[str, Any]):
    """Numbers by name that the package publishes, and that nobody can change.

    A copy is a usual dictionary.

    Raises:
        TypeError: from every method that would change it.
    """

    def _refuse(self, *_: object, **__: object) -> NoReturn:
        raise TypeError(
            f"these numbers belong to ms_highway: {dict(self)!r}; change a copy, such"
            " as dict(weights)"
        )

    __setitem__ = __delitem__ = __ior__ = _refuse
    clear = pop = popitem = setdefault = update = _refuse

    def __reduce__(self) -> tuple[type, tuple[dict]]:
        """Copy and pickle as a usual dictionary."""
        return dict, (dict(self),)


# Structures of numbers, read from JSON

# The upper limit refuses infinity, and numbers near it.
Positive = Annotated[float, msgspec.Meta(gt=0, lt=1e300)]


class Structure(msgspec.Struct, **{"frozen": True, "forbid_unknown_fields": True}):
    """Fields with types, checked by `read`."""


Kind = TypeVar("Kind")


def pytree(kind: type[Kind]) -> type[Kind]:
    """Let JAX take a structure's fields as arrays."""
    return jax.tree_util.register_dataclass(kind, kind.__struct_fields__, ())  # type: ignore[attr-defined]


def plain(structure: Kind) -> Kind:
    """Return a structure with numbers in place of its arrays, checked."""
    content = msgspec.to_builtins(
        structure, enc_hook=lambda array: np.asarray(array, dtype=float).tolist()
    )
    return msgspec.convert(content, type(structure))


def read(content: object, kind: type[Kind]) -> Kind:
    """Return the content of JSON as a structure.

    Raises:
        ValueError: naming the place, the wanted and, if it is short, the found value.
    """
    try:
        return msgspec.convert(content, kind)
    except msgspec.ValidationError as error:
        raise ValueError(_explained(str(error), content, kind)) from error


def _explained(message: str, content: object, kind: type) -> str:
    """Return a message of msgspec with the place of the wrong value, and the value.

    Args:
        message: the problem and, behind "at", a path such as ``$.peers[...].spread``.
        content: what was to be read.
        kind: of structure.
    """
    max_length = 80  # characters of a wrong value that is shown
    problem, _, path = message.partition(" - at `$")
    keys, value = _keys_and_value(
        content,
        path.rstrip("`"),
        lambda changed: _problem(changed, kind) == message,
    )

    place = ""
    for key in keys:
        place += f"[{key}]" if isinstance(key, int) else f".{key}"
    place = place.lstrip(".")

    shown = shortened(value)
    if not problem.startswith("Object") and len(shown) <= max_length:
        return f"{place or 'it'} is {shown}: {problem}"
    if place:
        return f"{place}: {problem}"
    return problem


def _problem(content: object, kind: type) -> str:
    """Return the problem of a structure's content; an empty text without one."""
    try:
        msgspec.convert(content, kind)
    except msgspec.ValidationError as error:
        return str(error)
    return ""


def _keys_and_value(
    content: Any,
    path: str,
    is_wrong: Callable[[object], bool],
) -> tuple[list[str | int], object]:
    """Follow a path of msgspec to the value that is wrong.

    In the path, ``[...]`` stands for any key of a mapping.

    Args:
        content: what was to be read.
        path: such as ``.peers[...].spread.along[1]``.
        is_wrong: tells whether the same is wrong with a changed content.

    Returns:
        The keys on the way, and the value.
    """
    # The first step is .NAME, [INDEX] or [...].
    step = re.match(r"\.(\w+)|\[(\d+)\]|\[\.\.\.\]", path)
    if not step:
        return [], content
    name, index = step.groups()
    key: str | int = name or int(index or 0)
    if not name and not index:
        # The same is wrong if the mapping has no other key.
        wrong_keys = (each for each in content if is_wrong({each: content[each]}))
        key = next(wrong_keys, next(iter(content)))

    def with_part(part: object) -> object:
        """Return the content with another value of the key."""
        if isinstance(content, dict):
            return {**content, key: part}
        return [*content[: int(key)], part, *content[int(key) + 1 :]]

    further_keys, value = _keys_and_value(
        content[key],
        path[step.end() :],
        lambda part: is_wrong(with_part(part)),
    )
    return [key, *further_keys], value
