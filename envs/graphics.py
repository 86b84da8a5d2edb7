"""What a person sees: the road from above, plans and predictions on it, and a panel with what the robot thinks."""

import os
import sys
from typing import Any

import jax
import numpy as np
import pygame
from highway_env.envs.common.graphics import EnvViewer
from highway_env.road.graphics import LaneGraphics
from highway_env.vehicle.graphics import VehicleGraphics
from jaxtyping import Float

from ms_highway.control.switching import ModelSwitching
from ms_highway.envs.words import Color, words
from ms_highway.game.dynamics import step
from ms_highway.game.scenario import title
from ms_highway.metareasoning.learned_value import LearnedValue
from ms_highway.planning.effort import Effort, base_of
from ms_highway.planning.human_models import MODELS, human_model, is_model
from ms_highway.planning.road.settings import RUNGS

__all__ = [
    "INK",
    "MARGIN",
    "MODEL_COLORS",
    "PAPER",
    "Color",
    "InteractionViewer",
    "Viewer",
    "check_display",
    "model_color",
    "model_meaning",
    "words",
]

MODEL_COLORS: dict[str, Color] = {"naive": (112, 178, 214), "turn": (240, 180, 50), "tom": (214, 68, 140)}
ROAD_COLORS: dict[str, Color] = {"idm": (120, 170, 90)}  # of models that predict on roads only
PALEST, DARKER = 0.6, 0.8  # shares: of white in the shade of the fewest steps, and of light from the last plan
FULL = 20  # steps, from which on a shade is the model's own colour
OTHER_COLORS = ((120, 170, 90), (150, 110, 200), (160, 120, 90))
MODEL_MEANINGS = {
    "naive": "the human keeps its velocity",
    "turn": "the human minds only itself",
    "tom": "the human responds to the robot",
}
INK, FAINT, PAPER, CONE = (32, 36, 44), (125, 130, 140), (250, 250, 247), (255, 120, 20)
GRID, GROUND, ASPHALT = (215, 218, 224), (205, 218, 195), (96, 100, 106)
MARGIN = 16  # px
TEXT_WIDTH = 440  # px, left part of the panel
LARGE, MEDIUM, SMALL = 26, 15, 13  # px, sizes of texts
WORST = -10.0  # reward below which the curve is cut: a collision would dwarf everything


def model_color(name: str | None) -> Color:
    """Return the colour of a human model, grey without one; registered models have colours in their order.

    A model with an effort has a shade of its own: the fewer steps, the lighter, and darker from the last plan.
    """
    if name in ROAD_COLORS:
        return ROAD_COLORS[name]
    if name is None or not is_model(name):
        return FAINT
    model = human_model(name)
    base = base_of(model).name
    registered = [known for known in MODELS if known not in MODEL_COLORS]
    color = MODEL_COLORS[base] if base in MODEL_COLORS else OTHER_COLORS[registered.index(base) % len(OTHER_COLORS)]
    if not isinstance(model, Effort):
        return color
    paler = PALEST * max(0.0, 1 - (model.steps or FULL) / FULL)
    red, green, blue = (round((part + paler * (255 - part)) * (DARKER if model.warm else 1)) for part in color)
    return red, green, blue


def model_meaning(name: str) -> str:
    """Return what a human model takes the human to do, in a few words; nothing for registered models."""
    return MODEL_MEANINGS.get(base_of(human_model(name)).name, "") if is_model(name) else ""


class Viewer(EnvViewer):
    """highway-env's viewer, which here draws also without a display, beside others of its kind."""

    def __init__(self, env: Any) -> None:
        displays = {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys()
        if env.render_mode == "rgb_array" and sys.platform == "linux" and not displays:
            os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # or else SDL complains that there is no screen
        super().__init__(env)
        self.enabled = True  # highway-env gives up under a dummy video driver; surfaces need no driver

    def close(self) -> None:
        """Close the window, if there is one; other environments of the process may still be drawing."""
        if not self.offscreen:
            pygame.display.quit()


class InteractionViewer(Viewer):
    """Draws an `ms_highway.envs.base.InteractionEnv` on a surface of ``screen_width`` x ``screen_height``."""

    panel_height = 150  # px

    def window_position(self) -> Float[np.ndarray, "2"]:
        """Return the centre of the view: it follows the robot along the road and keeps the road in place."""
        lanes = np.asarray(self.env.game.scene.lanes, dtype=float)
        return np.array([self.env.robot.position[0], (lanes.min() + lanes.max()) / 2])

    def display(self) -> None:
        """Draw everything."""
        surface, road = self.sim_surface, self.env.road
        surface.move_display_window_to(self.window_position())
        self._ground()
        for lane in road.network.lanes_list():
            LaneGraphics.display(lane, surface)
        for cone in road.objects:
            self._cone(cone)
        for car in road.vehicles:
            VehicleGraphics.display(car, surface, offscreen=self.offscreen)
        self._plans()
        self._names()
        self._panel()
        if not self.offscreen:
            self.screen.blit(surface, (0, 0))
            if self.config["real_time_rendering"]:
                self.clock.tick(self.config["simulation_frequency"])
            pygame.display.flip()

    def _ground(self) -> None:
        surface, scene = self.sim_surface, self.env.game.scene
        lanes, margin = np.asarray(scene.lanes, dtype=float), float(scene.lane_width) / 2
        _, top = surface.pos2pix(0, lanes.min() - margin)
        _, bottom = surface.pos2pix(0, lanes.max() + margin)
        surface.fill(GROUND)
        pygame.draw.rect(surface, ASPHALT, (0, top, surface.get_width(), bottom - top))

    def _names(self) -> None:
        """Draw the names of robot and human at the roadside."""
        (_, robot_start), (_, human_start), *_ = self.env.scenario.cars
        side = 1 if robot_start > human_start else -1
        self._name("robot", self.env.robot, side)
        self._name("human", self.env.human, -side)

    def _name(self, name: str, car: Any, side: int) -> None:
        """Draw the car's name at the roadside: -1 is the left, at the top."""
        surface, scene = self.sim_surface, self.env.game.scene
        reach = float(np.ptp(scene.lanes) + scene.lane_width) / 2
        x, _ = surface.vec2pix(car.position)
        _, y = surface.pos2pix(0, self.window_position()[1] + side * reach)
        label = words(name, MEDIUM, INK)
        surface.blit(label, label.get_rect(center=(x, y + 14 * side)))

    def _cone(self, cone: Any) -> None:
        surface = self.sim_surface
        x, y = surface.vec2pix(cone.position)
        box = pygame.Rect(0, 0, surface.pix(cone.LENGTH), surface.pix(cone.WIDTH))
        box.center = x, y
        pygame.draw.rect(surface, CONE, box, border_radius=5)
        pygame.draw.circle(surface, PAPER, (x, y), box.height // 4)

    def _plans(self) -> None:
        """Draw the robot's plan as a line and the predicted human path as dots, both in the model's colour."""
        robot = self.env.robot
        if robot.last_step is None:
            return
        color = model_color(robot.last_step.model)
        self._line(self._path(robot.last_state[0], robot.last_step.plan), color)
        self._dots(self._path(robot.last_state[1], robot.last_step.human)[1:], color)

    def _line(self, points: list[np.ndarray], color: Color) -> None:
        places = [self.sim_surface.vec2pix(point) for point in points]
        pygame.draw.lines(self.sim_surface, PAPER, False, places, 8)
        pygame.draw.lines(self.sim_surface, color, False, places, 4)

    def _dots(self, points: list[np.ndarray], color: Color) -> None:
        for point in points:
            place = self.sim_surface.vec2pix(point)
            pygame.draw.circle(self.sim_surface, PAPER, place, 6)
            pygame.draw.circle(self.sim_surface, color, place, 4)

    def _path(self, state: Float[np.ndarray, "4"], controls: Float[np.ndarray, "steps 2"]) -> list[np.ndarray]:
        points, dynamics = [state[:2]], jax.tree.map(float, self.env.game.dynamics)
        for control in controls:
            state = step(dynamics, state, control)
            points.append(state[:2])
        return points

    def _panel(self) -> None:
        surface = self.sim_surface
        width, height = surface.get_size()
        top = height - self.panel_height
        pygame.draw.rect(surface, PAPER, (0, top, width, self.panel_height))
        history = self.env.history
        if not history:
            self._text(f"{title(self.env.scenario.name)}: the episode starts", MEDIUM, INK, (MARGIN, top + MARGIN))
            return
        self._now(history[-1], top + 12)
        chart = pygame.Rect(TEXT_WIDTH, top + 26, width - TEXT_WIDTH - MARGIN, (self.panel_height - 66) // 2)
        if any(record["model"] for record in history):
            self._bars(chart)
        self._curve(chart.move(0, chart.height + 28))

    def _now(self, record: dict[str, Any], top: int) -> None:
        """Draw the left part: model, reward, seconds and, where the model is chosen here, gains of the last step."""
        model = record["model"]
        lines = [f"step {len(self.env.history)}    reward {record['reward']:+.2f}"]
        if record["collision"]:
            lines[0] += "    COLLISION"
        if model is None:
            self._text("the agent drives", LARGE, INK, (MARGIN, top))
        else:
            name = words(model, LARGE, PAPER)
            chip = pygame.Rect(MARGIN, top, name.get_width() + 2 * MARGIN, 36)
            pygame.draw.rect(self.sim_surface, model_color(model), chip, border_radius=8)
            self.sim_surface.blit(name, name.get_rect(center=chip.center))
            self._text(model_meaning(model), SMALL, INK, (chip.right + 10, top + 10))
            lines.append(f"planning {1e3 * record['planning_seconds']:.1f} ms")
            controller = self.env.robot.controller
            if isinstance(controller, ModelSwitching):
                lines[-1] += f", deciding {1e3 * record['decision_seconds']:.1f} ms"
                lines.append(_reason(record, isinstance(controller.rule, LearnedValue)))
        for place, line in enumerate(lines):
            self._text(line, MEDIUM, INK, (MARGIN, top + 48 + 26 * place))
        if record["belief"] is not None:
            self._belief(pygame.Rect(MARGIN, top + 119, TEXT_WIDTH - 5 * MARGIN, 17), record["belief"][0])

    def _belief(self, box: pygame.Rect, shares: Float[np.ndarray, "models"]) -> None:
        """Draw the probabilities of the models of a human, side by side, with their names where there is room."""
        ends = np.cumsum([0.0, *(box.width * shares)])
        for name, left, right in zip(RUNGS, ends, ends[1:], strict=False):
            part, label = pygame.Rect(box.left + left, box.top, right - left + 1, box.height), words(name, SMALL, PAPER)
            pygame.draw.rect(self.sim_surface, model_color(name), part)
            if part.width > label.get_width() and part.height >= label.get_height():
                self.sim_surface.blit(label, label.get_rect(center=part.center))

    def _chart(self, box: pygame.Rect, heading: str, low: str, high: str) -> None:
        """Draw the frame of a chart: a heading above, a line below, and the values of its ends on the left."""
        surface = self.sim_surface
        self._text(heading, SMALL, FAINT, (box.left, box.top - 20))
        pygame.draw.line(surface, FAINT, box.bottomleft, box.bottomright)
        for text, y in ((high, box.top), (low, box.bottom)):
            label = words(text, SMALL, FAINT)
            surface.blit(label, label.get_rect(midright=(box.left - 8, y)))

    def _step_width(self, box: pygame.Rect) -> float:
        return box.width / max(self.env.episode_steps, len(self.env.history))

    def _bars(self, box: pygame.Rect) -> None:
        """Draw one bar per step: its height is the planning time, its colour the model."""
        width, history = self._step_width(box), self.env.history
        longest = max(record["planning_seconds"] for record in history) or 1.0
        for place, record in enumerate(history):
            height = max(3, round(box.height * record["planning_seconds"] / longest))
            left = round(box.left + place * width)
            bar = (left, box.bottom - height, max(1, round(width) - 2), height)
            pygame.draw.rect(self.sim_surface, model_color(record["model"]), bar)
        self._chart(box, "planning time of each step [ms], in the colour of its model", "0", f"{1e3 * longest:.1f}")

    def _curve(self, box: pygame.Rect) -> None:
        """Draw the reward of each step, cut at its `WORST`; the line at 0 is drawn where it lies within."""
        width, rewards = self._step_width(box), [record["reward"] for record in self.env.history]
        low, high = max(min(rewards), WORST), max(*rewards, WORST + 1.0, min(rewards) + 1.0)

        def height(reward: float) -> float:
            return box.bottom - (max(reward, WORST) - low) / (high - low) * box.height

        if low < 0 < high:
            pygame.draw.line(self.sim_surface, GRID, (box.left, height(0)), (box.right, height(0)))
        points = [(box.left + (place + 0.5) * width, height(reward)) for place, reward in enumerate(rewards)]
        if len(points) > 1:
            pygame.draw.lines(self.sim_surface, INK, False, points, 2)
        pygame.draw.circle(self.sim_surface, INK, points[-1], 3)
        least = f"{low:.1f}" if min(rewards) >= WORST else f"below {WORST:.0f}"
        self._chart(box, f"reward of each step, {np.mean(rewards):+.2f} on average", least, f"{high:.1f}")

    def _text(self, text: str, size: int, color: Color, place: tuple[int, int]) -> None:
        self.sim_surface.blit(words(text, size, color), place)


def _reason(record: dict[str, Any], learned: bool) -> str:
    """Say why this model plans: the gain that was estimated, net of the price of planning.

    Algorithm 1 estimates what a step earns more, a learned value what all coming steps are worth more.
    """
    gains, model = record["gains"], record["model"]
    if record["choice_failed"]:
        return f"choice failed: {model} to be safe"
    if model in gains:
        return f"switched: {'worth' if learned else 'estimated net gain'} {gains[model]:+.3f}"
    if gains:
        told = ", ".join(f"{name} {gain:+.3f}" for name, gain in gains.items())
        return f"stays: {'worth' if learned else 'net gain'} of {told}"
    return "no switch considered"


def check_display() -> None:
    """Make sure that a window would be seen, unless the environment asks for a certain video driver.

    Raises:
        OSError: without a display.
    """
    unseen = False
    try:
        pygame.display.init()
        unseen = pygame.display.get_driver() in ("dummy", "offscreen") and "SDL_VIDEODRIVER" not in os.environ
    except pygame.error:
        unseen = True
    if unseen:
        raise OSError("there is no display for a person to drive at; use a desktop, or let a program drive")
