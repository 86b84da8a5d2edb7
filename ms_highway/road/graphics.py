"""Draw the robot's plan, predictions and rungs on the picture of a stock environment,
and a line of text below it.
"""

from collections import Counter
from operator import itemgetter
from typing import Any

import numpy as np
import pygame

from ms_highway.envs.colors import PALETTE, model_color
from ms_highway.envs.viewer import Viewer, words
from ms_highway.road.driver import RoadStep
from ms_highway.road.traffic_models import TRAFFIC_MODELS

PANEL, SIZE, GAP = (
    24,
    13,
    10,
)  # px: height of the line of text, size of its font, and gap between its parts
MEANINGS = {
    "proposal": "proposal: planned now",
    "last plan": "last plan: planned earlier",
}


def show(env: Any) -> None:
    """Let a `RoadViewer` draw an environment that is rendered, from the next picture
    on.
    """
    base = env.unwrapped
    if base.render_mode is not None and not isinstance(base.viewer, RoadViewer):
        base.viewer = RoadViewer(base)


class RoadViewer(Viewer):
    """Draws a stock environment like highway-env, the robot's plan and predictions, and
    a line of text below.
    """

    offscreen: bool

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        width, height = self.sim_surface.get_size()
        self.picture = pygame.Surface((width, height + PANEL))
        if not self.offscreen:
            self.screen = pygame.display.set_mode((width, height + PANEL))

    def display(self) -> None:
        """Draw everything."""
        offscreen, self.offscreen = (
            self.offscreen,
            True,
        )  # so that the window does not show an incomplete picture
        super().display()
        self.offscreen = offscreen
        step = getattr(self.env.vehicle, "last_step", None)
        for area in getattr(self.env, "goal_areas", ()):
            pygame.draw.polygon(
                self.sim_surface,
                PALETTE.paper,
                [self.sim_surface.vec2pix(corner) for corner in area],
                2,
            )
        if step is not None and not self.env.vehicle.crashed:
            self._draw_plan(step)
        self.picture.blit(self.sim_surface, (0, 0))
        self._draw_panel(step)
        self.show(self.picture)

    def get_image(self) -> np.ndarray:
        """Return the picture, [height, width, 3]."""
        return np.moveaxis(pygame.surfarray.array3d(self.picture), 0, 1)

    def _draw_plan(self, step: RoadStep) -> None:
        """Draw predictions as dots, their cars in the colours of the rungs, and the
        plan as a line.
        """
        ego = self.env.vehicle
        surface = self.sim_surface
        known = list(ego.road_memory.numbers)
        predictions = np.asarray(step.humans, dtype=float)
        predicted = [
            (TRAFFIC_MODELS.index(rung), known[owner], path)
            for rung, owner, path in zip(
                step.models, step.owners, predictions, strict=True
            )
            if rung
        ]
        for rung, car, path in sorted(
            predicted, key=itemgetter(0)
        ):  # the most expensive rung colours its car last
            color = model_color(TRAFFIC_MODELS[rung])
            if not car.crashed:
                pygame.draw.polygon(
                    surface,
                    color,
                    [surface.vec2pix(corner) for corner in car.polygon()],
                )
            for point in path[1::2]:
                pygame.draw.circle(surface, PALETTE.paper, surface.vec2pix(point), 3)
                pygame.draw.circle(surface, color, surface.vec2pix(point), 2)
        line = [
            surface.vec2pix(point)
            for point in (ego.position, *np.asarray(step.path, dtype=float)[:, :2])
        ]
        for color, width in (
            ((PALETTE.paper, 4), (PALETTE.ink, 2)) if len(line) > 1 else ()
        ):
            pygame.draw.lines(surface, color, False, line, width)

    def _draw_panel(self, step: RoadStep | None) -> None:
        """Write how many cars each rung predicts, what drives, and how long the plan
        took.
        """
        width, height = self.picture.get_size()
        pygame.draw.rect(self.picture, PALETTE.paper, (0, height - PANEL, width, PANEL))
        text = f"{self.env.vehicle.speed:.1f} m/s"
        place = GAP
        if step is not None:
            cars = dict.fromkeys(
                zip(step.models, np.asarray(step.owners).tolist(), strict=True)
            )  # each once
            for rung, count in Counter(rung for rung, _ in cars if rung).items():
                pygame.draw.circle(
                    self.picture, model_color(rung), (place + 4, height - PANEL // 2), 5
                )
                place = self._write(f"{rung} {count}", place + 14)
            milliseconds = 1e3 * (step.planning_seconds + step.decision_seconds)
            text = (
                f"{MEANINGS.get(step.source, step.source)}, {milliseconds:.1f} ms,"
                f" {text}"
            )
        self._write(text, place)

    def _write(self, text: str, place: int) -> int:
        """Write on the panel from a place on, and return the place after the text."""
        label = words(text, SIZE, PALETTE.ink)
        self.picture.blit(
            label,
            label.get_rect(midleft=(place, self.picture.get_height() - PANEL // 2)),
        )
        return place + label.get_width() + GAP
