"""Draw the robot's plan, predictions and rungs on pictures of stock environments.

A line of text stands below the road.
"""

from collections import Counter
from operator import itemgetter
from typing import ClassVar

import gymnasium as gym
import numpy as np
import pygame
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.vehicle.objects import RoadObject

from ms_highway.envs.colors import PALETTE, Color, model_color
from ms_highway.envs.viewer import Viewer, words
from ms_highway.road.driver import RoadStep
from ms_highway.road.traffic_models import TRAFFIC_MODELS

PANEL = 24
"""Height of the line of text below the road [px]."""


def show(env: gym.Env) -> None:
    """Let a `RoadViewer` draw an environment that is rendered.

    It draws from the next picture on.
    """
    base: AbstractEnv = env.unwrapped
    if base.render_mode is not None and not isinstance(base.viewer, RoadViewer):
        base.viewer = RoadViewer(base)


class RoadViewer(Viewer):
    """Draw a stock environment with the robot's plan and predictions.

    The road is drawn by highway-env; a line of text stands below it.
    """

    text_size: ClassVar[int] = 13
    """Size of the font [px]."""
    text_gap: ClassVar[int] = 10
    """Gap between the parts of the line [px]."""

    offscreen: bool

    def __init__(self, env: AbstractEnv) -> None:
        super().__init__(env)
        width, height = self.sim_surface.get_size()
        size = (width, height + PANEL)
        self.picture = pygame.Surface(size)
        if not self.offscreen:
            self.screen = pygame.display.set_mode(size)

    def display(self) -> None:
        """Draw everything."""
        # Draw the road aside, so that the window does not show an incomplete picture.
        offscreen = self.offscreen
        self.offscreen = True
        super().display()
        self.offscreen = offscreen

        step = getattr(self.env.vehicle, "last_step", None)
        for area in getattr(self.env, "goal_areas", ()):
            corners = [self.sim_surface.vec2pix(corner) for corner in area]
            pygame.draw.polygon(self.sim_surface, PALETTE.paper, corners, 2)
        if step is not None and not self.env.vehicle.crashed:
            self._draw_plan(step)
        self.picture.blit(self.sim_surface, (0, 0))
        self._draw_panel(step)
        self.show(self.picture)

    def get_image(self) -> np.ndarray:
        """Return the picture, [height, width, 3]."""
        return np.moveaxis(pygame.surfarray.array3d(self.picture), 0, 1)

    def _draw_plan(self, step: RoadStep) -> None:
        """Draw predictions as dots, and the plan as a line.

        Predicted cars have the colours of their rungs.
        """
        ego = self.env.vehicle
        surface = self.sim_surface
        known_cars = list(ego.road_memory.numbers)
        predictions = np.asarray(step.humans, dtype=float)  # [paths, steps, 2]

        # The paths with a prediction; the most expensive rung colours its car last.
        predicted = []
        for rung, owner, path in zip(
            step.models, step.owners, predictions, strict=True
        ):
            if rung:
                number = TRAFFIC_MODELS.index(rung)
                predicted.append((number, known_cars[owner], path))
        predicted.sort(key=itemgetter(0))
        for number, car, path in predicted:
            color = model_color(TRAFFIC_MODELS[number])
            self._draw_prediction(car, path, color)

        # The plan, with a light border.
        positions = np.asarray(step.path, dtype=float)[:, :2]
        line = [surface.vec2pix(point) for point in (ego.position, *positions)]
        if len(line) > 1:
            pygame.draw.lines(surface, PALETTE.paper, False, line, 4)
            pygame.draw.lines(surface, PALETTE.ink, False, line, 2)

    def _draw_prediction(self, car: RoadObject, path: np.ndarray, color: Color) -> None:
        """Colour a car, and draw every second predicted position as a dot.

        Args:
            car: that is predicted.
            path: x and y after each step [steps, 2].
            color: of its rung.
        """
        surface = self.sim_surface
        if not car.crashed:
            corners = [surface.vec2pix(corner) for corner in car.polygon()]
            pygame.draw.polygon(surface, color, corners)
        for point in path[1::2]:
            middle = surface.vec2pix(point)
            pygame.draw.circle(surface, PALETTE.paper, middle, 3)
            pygame.draw.circle(surface, color, middle, 2)

    def _draw_panel(self, step: RoadStep | None) -> None:
        """Write what drives, and how long the plan took.

        Before that, write how many cars each rung predicts.
        """
        width, height = self.picture.get_size()
        panel = (0, height - PANEL, width, PANEL)
        pygame.draw.rect(self.picture, PALETTE.paper, panel)
        text = f"{self.env.vehicle.speed:.1f} m/s"
        place = self.text_gap
        if step is not None:
            # Each car counts once, however many paths it may take.
            owners = np.asarray(step.owners).tolist()
            rungs_of_cars = dict.fromkeys(zip(step.models, owners, strict=True))
            counts = Counter(rung for rung, _ in rungs_of_cars if rung)
            for rung, count in counts.items():
                middle = (place + 4, height - PANEL // 2)
                pygame.draw.circle(self.picture, model_color(rung), middle, 5)
                place = self._write(f"{rung} {count}", place + 14)

            meanings = {
                "proposal": "proposal: planned now",
                "last plan": "last plan: planned earlier",
            }
            meaning = meanings.get(step.source, step.source)
            seconds = step.planning_seconds + step.decision_seconds
            milliseconds = 1e3 * seconds
            text = f"{meaning}, {milliseconds:.1f} ms, {text}"
        self._write(text, place)

    def _write(self, text: str, place: int) -> int:
        """Write on the panel from a place on, and return the place after the text."""
        label = words(text, self.text_size, PALETTE.ink)
        middle = self.picture.get_height() - PANEL // 2
        position = label.get_rect(midleft=(place, middle))
        self.picture.blit(label, position)
        return place + label.get_width() + self.text_gap
