"""Keep what is known of the drivers in sight from step to step: what each is like, and which model it follows."""

from dataclasses import replace
from functools import cache
from typing import Any

import jax
import numpy as np

from ms_highway.game.road import RoadScene
from ms_highway.metareasoning.road_belief import Belief, first_belief, updated_road_belief
from ms_highway.planning.road.traits import prior, traits_of, updated_traits
from ms_highway.runtime.compilation import quick_options
from ms_highway.runtime.timing import warm_up


@cache
def _functions() -> tuple[jax.stages.Wrapped, jax.stages.Wrapped]:
    """Compile what is assumed of drivers in the first step, and the update of it."""

    def update(known: Any, before: RoadScene, path: Any, now: RoadScene, time_step: float) -> Any:
        estimates, belief = known
        traits = updated_traits(estimates, before, now, time_step)
        return traits, updated_road_belief(belief, before, path, now, time_step)

    options = quick_options()
    first = jax.jit(lambda scene: (prior(scene), first_belief(scene)), compiler_options=options)
    return first, jax.jit(update, compiler_options=options)


class DriversSeen:
    """Estimates and belief about the drivers in sight, updated in every step of a robot.

    Args:
        traits: whether plans use the estimates of what drivers are like.
        time_step: between two steps [s].
    """

    def __init__(self, traits: bool, time_step: float) -> None:
        self.traits, self.time_step = traits, time_step
        self._before: tuple[RoadScene, Any] | None = None
        self._known: Any = None

    def prepare(self, scene: RoadScene, steps: int) -> None:
        """Compile, with a look at the road and the number of steps of plans."""
        first, update = _functions()
        warm_up(first, scene)
        known = first(scene)
        warm_up(update, known, self._with_traits(scene, known), np.zeros((steps, 3), np.float32), scene, self.time_step)

    def look(self, scene: RoadScene) -> RoadScene:
        """Learn from a look at the road; return it, with the traits of the drivers if plans use them."""
        first, update = _functions()
        if self._before is None:
            self._known = first(scene)
        else:
            self._known = update(self._known, *self._before, scene, self.time_step)
        return self._with_traits(scene, self._known)

    def _with_traits(self, scene: RoadScene, known: Any) -> RoadScene:
        return replace(scene, traits=jax.tree.map(np.asarray, traits_of(known[0].mean))) if self.traits else scene

    def planned(self, scene: RoadScene, path: Any) -> None:
        """Remember the robot's plan on the road that it looked at last; an empty one ends all learning until now."""
        self._before = (scene, path) if len(path) else None

    @property
    def belief(self) -> Belief:
        """Probability of each model for the car on each path, after the last look."""
        if self._known is None:
            raise RuntimeError("nobody has been seen yet; look at the road first")
        return np.asarray(self._known[1])
