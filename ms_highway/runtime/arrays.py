"""Name arrays by their shapes, loop over rows, and read structures of numbers from
JSON.

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
    """Compute a function of every row of pytrees of arrays; a single row needs no
    `jax.vmap`, so it compiles faster.
    """
    if len(jax.tree.leaves(arrays)[0]) > 1:
        return jax.vmap(function)(*arrays)
    return jax.tree.map(
        lambda part: part[None], function(*jax.tree.map(lambda part: part[0], arrays))
    )


def for_numbers(count: int, function: Callable[[Index], Tree]) -> Tree:
    """Compute a function of 0, 1, ..., one by one, and stack the results; a single one
    needs no loop.
    """
    if count == 1:
        return jax.tree.map(lambda part: jnp.asarray(part)[None], function(0))
    return jax.lax.map(function, jnp.arange(count))


def for_each(
    chosen: Bool[Array, "n"],
    function: Callable[[Index, Tree], Tree],
    start: Tree,
) -> Tree:
    """Loop over the chosen rows, one round for each, so that the time is proportional
    to their number.

    Where no row is chosen, nothing is computed: without the condition, XLA would
    compute before the loop whatever is the same in all rounds.

    Args:
        chosen: rows to loop over.
        function: takes the number of a row and the result so far, and returns the next
            result.
        start: first result.
    """

    def loop() -> Tree:
        order = jnp.argsort(-chosen.astype(int), stable=True)
        return jax.lax.fori_loop(
            0,
            jnp.sum(chosen),
            lambda place, found: function(order[place], found),
            start,
        )

    return jax.lax.cond(chosen.any(), loop, lambda: start)


def read_only(tree: Tree) -> Tree:
    """Return a pytree whose NumPy arrays cannot be written; they are views of the same
    numbers.

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
    """Numbers by name that the package publishes, and that nobody can change; a copy is
    a usual dictionary.

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

MAX_NUMBER = 1e300
LONGEST = 80  # characters of a wrong value that a message shows

Positive = Annotated[float, msgspec.Meta(gt=0, lt=MAX_NUMBER)]


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
        problem, _, path = str(error).partition(" - at `$")
        keys, found = _followed(
            content,
            path.rstrip("`"),
            lambda changed: _problem(changed, kind) == str(error),
        )
        shown = shortened(found)
        hidden = problem.startswith("Object") or len(shown) > LONGEST
        place = "".join(
            f"[{key}]" if isinstance(key, int) else f".{key}" for key in keys
        ).lstrip(".")
        where = f"{place}: " if hidden else f"{place or 'it'} is {shown}: "
        raise ValueError(f"{where if place or not hidden else ''}{problem}") from error


def _problem(content: object, kind: type) -> str:
    """Return the problem of a structure's content; an empty text without one."""
    try:
        msgspec.convert(content, kind)
    except msgspec.ValidationError as error:
        return str(error)
    return ""


def _followed(
    content: Any,
    path: str,
    is_wrong: Callable[[Any], bool],
) -> tuple[list[str | int], Any]:
    """Follow a path of msgspec, in which ``[...]`` stands for any key of a mapping, to
    the value that is wrong.

    Args:
        content: what was to be read.
        path: such as ``.peers[...].spread.along[1]``.
        is_wrong: tells whether the same is wrong with a changed content.

    Returns:
        The keys on the way, and the value.
    """
    step = re.match(r"\.(\w+)|\[(\d+)\]|\[\.\.\.\]", path)
    if not step:
        return [], content
    name, number = step.groups()
    key: str | int = name or int(number or 0)
    if not name and not number:  # the same is wrong if the mapping has no other key
        key = next(
            (each for each in content if is_wrong({each: content[each]})),
            next(iter(content)),
        )

    def with_part(part: Any) -> Any:
        if isinstance(content, dict):
            return {**content, key: part}
        return [*content[: int(key)], part, *content[int(key) + 1 :]]

    keys, found = _followed(
        content[key], path[step.end() :], lambda part: is_wrong(with_part(part))
    )
    return [key, *keys], found
