"""Name the kinds of scenes for which the package has costs and learned values."""

from typing import Literal, TypeAlias

from ms_highway.runtime.arrays import Published

SceneKind: TypeAlias = Literal["pair", "physical", "several", "physical several"]
"""Number of humans and physics of a scene. With one human, ``pair`` is the paper's
scene, and ``physical`` one within what tyres hold. With several humans, these are
``several`` and ``physical several``.
"""

PUBLISHED_COSTS = Published({"naive": 0.09, "turn": 0.17, "tom": 0.37})  # s
"""Planning time of each model, as the decisions in the paper's experiments count it."""

SHIPPED_COSTS: dict[SceneKind, dict[str, float]] = {  # s
    "pair": {"naive": 0.0007, "idm": 0.0007, "turn": 0.0013, "tom": 0.0011},
    "physical": {"naive": 0.0007, "idm": 0.0007, "turn": 0.0013, "tom": 0.0011},
    "several": {"naive": 0.0012, "idm": 0.0012, "turn": 0.0018, "tom": 0.0018},
    "physical several": {"naive": 0.0011, "idm": 0.0011, "turn": 0.0014, "tom": 0.0014},
}
"""Planning time of each model. With several humans, it is the time of a plan in which
the model predicts one of them and naive the others.

These are means over episodes on one core, including the search for a way out: of Merger
v1 and Give Way v1 with one human, and with several of Dense Merge (six episodes) and
Dense Merge v1 (20). That search became faster afterwards. Each mean with several humans
is therefore multiplied by a ratio: the time of 12 episodes with the faster search over
their time with the slower one.
"""

VALUE_FILES: dict[SceneKind, str] = {
    "pair": "values.npz",
    "physical": "physical_values.npz",
    "several": "several_values.npz",
    "physical several": "crowd_values.npz",
}
"""Files of learned values in ``ms_highway/data``."""


def shipped_kind(semantics: str, humans: int) -> SceneKind:
    """Return the kind of a scene, by its semantics and its number of humans."""
    if humans == 1:
        return "physical" if semantics == "physical" else "pair"
    return "physical several" if semantics == "physical" else "several"
