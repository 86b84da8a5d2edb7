"""Keep what is known of the drivers in sight from step to step: what each is like, and which model it follows."""

from dataclasses import replace
from functools import cache

import jax
import numpy as np
from jaxtyping import Float

from ms_highway.game.road import RoadScene
from ms_highway.metareasoning.road_belief import Belief, first_belief, updated_road_belief
from ms_highway.planning.road.traits import Estimates, prior, traits_of, updated_traits
from ms_highway.runtime.compilation import quick_options
from ms_highway.runtime.timing import warm_up

__all__ = ["DriversSeen"]


@cache
def _first_function() -> jax.stages.Wrapped:
    """Compile what is assumed of drivers in the first step."""
    return jax.jit(lambda scene: (prior(scene), first_belief(scene)), compiler_options=quick_options())


@cache
def _update_function() -> jax.stages.Wrapped:
    """Compile the update of both estimates and belief."""

    def update(
        estimates: Estimates, belief: Belief, before: RoadScene, path: jax.Array, now: RoadScene, time_step: float
    ) -> tuple[Estimates, Belief]:
        return (
            updated_traits(estimates, before, now, time_step),
            updated_road_belief(belief, before, path, now, time_step),
        )

    return jax.jit(update, compiler_options=quick_options())


class DriversSeen:
    """Estimates and belief about the drivers in sight, updated in every step of a robot.

    Args:
        traits: whether plans use the estimates of what drivers are like.
        time_step: between two steps [s].
    """

    def __init__(self, traits: bool, time_step: float) -> None:
        self.traits, self.time_step = traits, time_step
        self._before: tuple[RoadScene, Float[np.ndarray, "steps 3"]] | None = None
        self._known: tuple[Estimates, Belief] | None = None

    def prepare(self, scene: RoadScene, steps: int) -> None:
        """Compile, with a look at the road and the number of steps of plans."""
        warm_up(_first_function(), scene)
        known = _first_function()(scene)
        path = np.zeros((steps, 3), np.float32)
        warm_up(_update_function(), *known, self._told(scene, known), path, scene, self.time_step)

    def look(self, scene: RoadScene) -> RoadScene:
        """Learn from a look at the road; return it, with the traits of the drivers if plans use them."""
        if self._before is None or self._known is None:
            self._known = _first_function()(scene)
        else:
            self._known = _update_function()(*self._known, *self._before, scene, self.time_step)
        return self._told(scene, self._known)

    def _told(self, scene: RoadScene, known: tuple[Estimates, Belief]) -> RoadScene:
        return replace(scene, traits=jax.tree.map(np.asarray, traits_of(known[0]))) if self.traits else scene

    def planned(self, scene: RoadScene, path: Float[np.ndarray, "steps 3"]) -> None:
        """Remember the robot's plan on the road that it looked at last; an empty one ends all learning until now."""
        self._before = (scene, path) if len(path) else None

    @property
    def belief(self) -> Float[np.ndarray, "traffic models"]:
        """Probability of each model for the car on each path, after the last look."""
        if self._known is None:
            raise RuntimeError("nobody has been seen yet; look at the road first")
        return np.asarray(self._known[1].probabilities)
