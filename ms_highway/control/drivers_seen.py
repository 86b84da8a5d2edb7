"""Keep what is known of the drivers in sight from step to step: what each is like, and which model it follows."""

from dataclasses import replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from ms_highway.game.arrays import Belief
from ms_highway.game.road import RoadScene
from ms_highway.metareasoning.belief import first_belief
from ms_highway.metareasoning.road_belief import updated_road_belief
from ms_highway.optimization.kalman import Gaussian
from ms_highway.planning.road.traits import prior, traits_of, updated_traits
from ms_highway.runtime.compilation import jit_quickly
from ms_highway.runtime.timing import warm_up

Known = tuple[Gaussian, Belief]
Path = Float[Any, "steps 3"]


def _updated(known: Known, before: RoadScene, path: Path, now: RoadScene, time_step: float) -> Known:
    traits = updated_traits(known[0], before, now, time_step)
    return traits, updated_road_belief(known[1], before, path, now, time_step)


_first, _update = jit_quickly(prior), jit_quickly(_updated)


class DriversSeen:
    """Estimates and belief about the drivers in sight, updated in every step of a robot.

    Args:
        traits: whether plans use the estimates of what drivers are like.
        time_step: between two steps [s].
    """

    def __init__(self, traits: bool, time_step: float) -> None:
        self.traits, self.time_step = traits, time_step
        self._before: tuple[RoadScene, Path] | None = None
        self._known: Known | None = None

    def prepare(self, scene: RoadScene, steps: int) -> None:
        """Compile, with a look at the road and the number of steps of plans."""
        warm_up(_first, scene)
        seen = DriversSeen(self.traits, self.time_step)
        before, path = seen.look(scene), np.zeros((steps, 3), np.float32)
        warm_up(_update, seen._known, before, path, scene, self.time_step)

    def look(self, scene: RoadScene) -> RoadScene:
        """Learn from a look at the road; return it, with the traits of the drivers if plans use them."""
        if self._before is None:
            self._known = _first(scene), first_belief(len(scene.names))
        else:
            self._known = _update(self._known, *self._before, scene, self.time_step)
        return replace(scene, traits=jax.tree.map(np.asarray, traits_of(self._known[0].mean))) if self.traits else scene

    def planned(self, scene: RoadScene, path: Path) -> None:
        """Remember the robot's plan on the road that it looked at last; an empty one ends all learning until now."""
        self._before = (scene, path) if len(path) else None

    @property
    def belief(self) -> Belief:
        """Probability of each model for the car on each path, after the last look."""
        if self._known is None:
            raise RuntimeError("nobody has been seen yet; look at the road first")
        return np.asarray(self._known[1])
