"""What a person sees: the road from above, plans and predictions on it, and a panel with what the robot thinks."""

import os
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from itertools import accumulate
from typing import Any

import jax
import matplotlib
import numpy as np
import pygame
import pygame.freetype
from highway_env.envs.common.graphics import EnvViewer
from highway_env.envs.common.observation import GrayscaleObservation
from highway_env.road.graphics import LaneGraphics, RoadGraphics, WorldSurface

from ms_highway.choice.learned_value import LearnedValue
from ms_highway.choice.rule import Order
from ms_highway.game.dynamics import step as move
from ms_highway.game.scenario import title
from ms_highway.loop.controller import ControlStep
from ms_highway.planning.human_models import MODELS, PACKAGE_MODELS, cheapest_first, human_model, is_model
from ms_highway.runtime.arrays import Belief, Car, Controls

Color = tuple[int, ...]

MODEL_COLORS: dict[str, Color] = {
    "naive": (112, 178, 214),
    "idm": (120, 170, 90),
    "turn": (240, 180, 50),
    "tom": (214, 68, 140),
}
OTHER_COLORS = ((150, 110, 200), (160, 120, 90), (90, 150, 150))
PALEST, DARKER = 0.6, 0.8  # shares: of white in the shade of the fewest steps, and of light from the last plan
FULL = 20  # steps, from which on a shade is the model's own colour
MODEL_MEANINGS = {
    "naive": "the human keeps its velocity",
    "idm": "the human minds the car ahead",
    "turn": "the human minds only itself",
    "tom": "the human responds to the robot",
}
INK, FAINT, PAPER, CONE = (32, 36, 44), (125, 130, 140), (250, 250, 247), (255, 120, 20)
GRID, GROUND, ASPHALT = (215, 218, 224), (205, 218, 195), (96, 100, 106)
MARGIN = 16  # px
TEXT_WIDTH, CHART = 440, 42  # px, width of the panel's left part, height of a chart
LARGE, MEDIUM, SMALL = 24, 15, 13  # px, sizes of texts
NAMED = 60  # px, width from which on a part of a bar is named
FONT = f"{matplotlib.get_data_path()}/fonts/ttf/DejaVuSans.ttf"
WORST = -10.0  # reward below which the curve is cut: a collision would dwarf everything


def words(text: str, size: int, color: Color, ground: Color | None = None) -> pygame.Surface:
    """Draw a line of text in a kerned font of ``size`` px, on a surface of the same height for every text.

    The font is Matplotlib's, so that pictures are the same on every machine. It is opened anew each time, since closing
    any of highway-env's viewers ends the font module.
    """
    pygame.freetype.init()
    font = pygame.freetype.Font(FONT, size)
    font.kerning = font.pad = True
    return font.render(text, color, ground)[0]


def model_color(name: str | None) -> Color:
    """Return the colour of a human model, grey without one; registered models have colours in their order.

    A model with an effort has a shade of its own: the fewer steps, the lighter, and darker from the last plan.
    """
    if name is None or not is_model(name):
        return FAINT
    model = human_model(name)
    base = type(model).name
    registered = [known for known in MODELS if known not in MODEL_COLORS]
    color = MODEL_COLORS.get(base) or OTHER_COLORS[registered.index(base) % len(OTHER_COLORS)]
    paler = PALEST * max(0.0, 1 - (model.steps or FULL) / FULL)
    return tuple(round((part + paler * (255 - part)) * (DARKER if model.warm else 1)) for part in color)


def model_meaning(name: str) -> str:
    """Return what a human model takes the human to do, in a few words; nothing for registered models."""
    return MODEL_MEANINGS.get(type(human_model(name)).name, "") if is_model(name) else ""


class PictureViewer(EnvViewer):
    """highway-env's viewer of image observations; it can be copied and also draws under a dummy video driver."""

    def __init__(self, env: Any, config: Any) -> None:
        super().__init__(env, config)
        self.enabled = True  # highway-env gives up under a dummy video driver; surfaces need no driver

    def __reduce__(self) -> Any:
        """Copy and pickle as a new viewer of the same environment."""
        return type(self), (self.env, self.config)


def enable_pictures(env: Any) -> bool:
    """Give each image observation of an environment a `PictureViewer`; return whether one could not draw before."""
    kind, black = env.observation_type, False
    parts = getattr(kind, "observation_types", None) or getattr(kind, "agents_observation_types", [kind])
    for part in parts:
        if isinstance(part, GrayscaleObservation) and not isinstance(part.viewer, PictureViewer):
            black |= not part.viewer.enabled
            part.viewer = PictureViewer(env, part.viewer.config)
    return black


class Viewer(EnvViewer):
    """highway-env's viewer, which here draws also without a display, beside others of its kind."""

    # all else that `EnvViewer.__init__` sets
    observer_vehicle, agent_surface, vehicle_trajectory, directory, frame = None, None, None, None, 0

    def __init__(self, env: Any) -> None:
        self.env, self.config, self.offscreen = env, env.config, env.config["offscreen_rendering"]
        if not self.offscreen:
            super().__init__(env)
        else:  # without `pygame.display`, which surfaces do not need, and which may complain that there is no screen
            pygame.font.init()  # for labels
            size = self.config["screen_width"], self.config["screen_height"]
            self.sim_surface = WorldSurface(size, 0, pygame.Surface(size))
            self.sim_surface.scaling = self.config["scaling"]
            self.sim_surface.centering_position = self.config["centering_position"]
            if self.agent_display:
                self.extend_display()
        self.enabled = True  # highway-env gives up under a dummy video driver; surfaces need no driver

    def show(self, picture: pygame.Surface) -> None:
        """Show a picture in the window, if there is one, at the environment's pace."""
        if not self.offscreen:
            self.screen.blit(picture, (0, 0))
            if self.env.config["real_time_rendering"]:
                self.clock.tick(self.env.config["simulation_frequency"])
            pygame.display.flip()

    def __reduce__(self) -> tuple[type[None], tuple[()]]:
        """Copy and pickle as None; the copied environment makes its own viewer when it renders."""
        return type(None), ()

    def close(self) -> None:
        """Close the window, if there is one; other environments of the process may still be drawing."""
        if not self.offscreen:
            pygame.display.quit()


class InteractionViewer(Viewer):
    """Draws an `ms_highway.envs.base.InteractionEnv` on a surface of ``screen_width`` x ``screen_height``.

    Predicted paths have the colours of the models that predict them; among several humans, so have the humans.
    """

    panel_height = 150  # px
    longest = 0.0  # s, longest planning time in all films that share this scale

    def display(self) -> None:
        """Draw everything; the view follows the robot along the road and keeps the road in place."""
        surface, env, step = self.sim_surface, self.env, self.env.robot.last_step
        lanes, half = np.asarray(env.game.scene.lanes, float), float(env.game.scene.lane_width) / 2
        ends = lanes.min() - half, lanes.max() + half
        surface.move_display_window_to(np.array([env.robot.position[0], np.mean(ends)]))
        above, below = (surface.pos2pix(0, end)[1] for end in ends)
        surface.fill(GROUND)
        surface.fill(ASPHALT, (0, above, surface.get_width(), below - above))
        for lane in env.road.network.lanes_list():
            LaneGraphics.display(lane, surface)
        for cone in env.road.objects:
            pygame.draw.polygon(surface, CONE, [surface.vec2pix(corner) for corner in cone.polygon()])
            pygame.draw.circle(surface, PAPER, surface.vec2pix(cone.position), surface.pix(cone.WIDTH / 4))
        for place, human in enumerate(env.humans if len(env.humans) > 1 else ()):
            human.color = model_color(step.models[place] if step else env.settings.models[0].name)
        RoadGraphics.display_traffic(env.road, surface, offscreen=self.offscreen)
        if step:
            self._draw_plan(step)
        self._draw_names(range(above, below))
        self._draw_panel(step)
        self.show(surface)

    def _draw_plan(self, step: ControlStep) -> None:
        """Draw the predicted paths as dots in the colours of their models, and the robot's plan as a line."""
        surface, (own, *others) = self.sim_surface, self.env.robot.last_state
        every, radius = (1, 4) if len(step.models) == 1 else (2, 2)
        for state, controls, model in zip(others, step.humans, step.models, strict=False):
            for point in self._path(state, controls)[every::every]:
                pygame.draw.circle(surface, PAPER, point, radius + 2)
                pygame.draw.circle(surface, model_color(model), point, radius)
        for color, width in ((PAPER, 8), (model_color(step.model), 4)):
            pygame.draw.lines(surface, color, False, self._path(own, step.plan), width)

    def _path(self, state: Car, controls: Controls) -> list[tuple[int, int]]:
        dynamics = jax.tree.map(float, self.env.game.dynamics)
        states = accumulate(controls, partial(move, dynamics), initial=state)
        return [self.sim_surface.vec2pix(each) for each in states]

    def _draw_names(self, road: range) -> None:
        """Draw the names of robot and human beside them; of several humans, a number on each roof."""
        humans, (robot, *others) = self.env.humans, self.env.scenario.cars
        side = -1 if others and robot[1] < others[0][1] else 1
        labels = {"robot": (self.env.robot, side)}
        if len(humans) == 1:
            labels["human"] = humans[0], -side
        else:
            labels |= {str(place): (human, 0) for place, human in enumerate(humans, 1)}
        for name, (car, side) in labels.items():
            x, y = self.sim_surface.vec2pix(car.position)
            if side:
                y = max(self.sim_surface.vec2pix(corner)[1] * side for corner in car.polygon()) * side + 12 * side
            colors = (INK, None) if not side else (PAPER, ASPHALT) if y in road else (INK, GROUND)
            self._write(name, MEDIUM, *colors, center=(x, y))

    def _draw_panel(self, step: ControlStep | None) -> None:
        env, history, (width, height) = self.env, self.env.history, self.sim_surface.get_size()
        top = height - self.panel_height
        self.sim_surface.fill(PAPER, (0, top, width, self.panel_height))
        if not history:
            self._write(f"{title(env.scenario.name)}: the episode starts", MEDIUM, topleft=(MARGIN, top + MARGIN))
            return
        steps, rewards = zip(*history, strict=True)
        arrived = env.scenario.streams and env.success
        happened = "COLLISION" if env.collision else "in the target lane" if arrived else ""
        lines = [f"step {len(history)}    reward {rewards[-1]:+.2f}    {happened}"]
        chart = pygame.Rect(TEXT_WIDTH, top + 26, width - TEXT_WIDTH - MARGIN, CHART)
        self._draw_curve(chart.move(0, CHART + 28), rewards)
        if step:
            lines += self._thoughts(step)
            self._draw_models(step, MARGIN, top + 10)
            self._draw_bars(chart, steps)
            if step.belief is not None:
                self._draw_beliefs(step.belief, top + 122)
        else:
            self._write("the agent drives", LARGE, topleft=(MARGIN, top + 10))
        for place, line in enumerate(lines):
            self._write(line, MEDIUM, topleft=(MARGIN, top + 46 + 24 * place))

    def _draw_models(self, step: ControlStep, left: int, top: int) -> None:
        """Draw the model with what it means; of several humans, how many each model predicts."""
        alone = len(step.models) == 1
        for name in step.models if alone else dict.fromkeys((*step.ladder, *step.models)):
            text = f" {name} " if alone else f" {name} {step.models.count(name)} "
            left = 8 + self._write(text, LARGE, PAPER, model_color(name), topleft=(left, top)).right
        if alone:
            self._write(model_meaning(step.model), SMALL, topleft=(left, top + 8))

    def _thoughts(self, step: ControlStep) -> tuple[str, str]:
        """Return two lines: the times; why the only human's model plans, the way to the cones, the plan's status."""
        controller, cones, remarks = self.env.robot.controller, self.env.distance_to_cones, []
        times = {"planning": step.planning_seconds, "deciding": step.decision_seconds, "budget": controller.budget}
        if len(step.models) == 1 and not isinstance(controller.rule, Order):
            remarks.append(_reason(step, isinstance(controller.rule, LearnedValue)))
        if self.env.scenario.streams and cones < np.inf:
            remarks.append(f"cones in {cones:.0f} m")
        if step.status != "planned":
            remarks.append(step.status)
        taken = [f"{name} {1e3 * seconds:.1f} ms" for name, seconds in times.items() if seconds]
        return ", ".join(taken), "    ".join(remarks)

    def _draw_beliefs(self, belief: Belief, top: int) -> None:
        """Draw the probabilities of the models of every human, side by side, behind its number."""
        width = (TEXT_WIDTH - 5 * MARGIN) / len(belief)
        for place, shares in enumerate(belief):
            left = start = MARGIN + place * width
            if len(belief) > 1:
                start = self._write(str(place + 1), SMALL, topleft=(left, top)).right + 3
            ends = start + (left + width - 4 - start) * np.cumsum([0.0, *shares])
            for name, low, high in zip(PACKAGE_MODELS, ends, ends[1:], strict=False):
                part = self.sim_surface.fill(model_color(name), (low, top, high - low + 1, 17))
                if part.width > NAMED:
                    self._write(name, SMALL, PAPER, center=part.center)

    def _draw_chart(
        self, box: pygame.Rect, heading: str, values: Sequence[float], low: float, high: float
    ) -> list[pygame.Rect]:
        """Draw a heading above, a line below, and both ends on the left; return the bar of every step's value."""
        self._write(heading, SMALL, FAINT, topleft=(box.left, box.top - 20))
        self._write(f"{high:.3g}", SMALL, FAINT, midright=(box.left - 8, box.top))
        self._write(f"{low:.3g}", SMALL, FAINT, midright=(box.left - 8, box.bottom))
        pygame.draw.line(self.sim_surface, FAINT, box.bottomleft, box.bottomright)
        width = box.width / max(self.env.episode_steps, len(values))
        heights = np.interp(values, [low, high], [3, box.height])
        return [
            pygame.Rect(box.left + place * width, box.bottom - height, max(1, width - 2), height)
            for place, height in enumerate(heights)
        ]

    def _draw_bars(self, box: pygame.Rect, steps: Sequence[ControlStep]) -> None:
        """Draw a bar per step in the colours of the humans' models: its height is the time of planning for one."""
        humans = len(steps[0].models)
        values, heading, high = [float(humans)] * len(steps), "humans that each model predicts", float(humans)
        if humans == 1:
            values = [1e3 * step.planning_seconds for step in steps]
            heading = "planning time of each step [ms], in the colour of its model"
            high = max(*values, 1e3 * self.longest)
        for step, bar in zip(steps, self._draw_chart(box, heading, values, 0.0, high), strict=True):
            for place, model in enumerate(sorted(step.models, key=cheapest_first(step.models).index)):
                top = bar.top + bar.height * place / humans
                self.sim_surface.fill(model_color(model), (bar.left, top, bar.width, bar.bottom - top))

    def _draw_curve(self, box: pygame.Rect, rewards: Sequence[float]) -> None:
        """Draw the reward of each step, cut at its `WORST`; the line at 0 is drawn where it lies within."""
        low = max(min(rewards), WORST)
        high = max(*rewards, low + 1.0)
        heading = f"reward of each step, {np.mean(rewards):+.2f} on average"
        points = [bar.midtop for bar in self._draw_chart(box, heading, rewards, low, high)]
        if low < 0 < high:
            zero = np.interp(0.0, [low, high], [box.bottom, box.top])
            pygame.draw.line(self.sim_surface, GRID, (box.left, zero), (box.right, zero))
        pygame.draw.lines(self.sim_surface, INK, False, [points[0], *points], 2)
        pygame.draw.circle(self.sim_surface, INK, points[-1], 3)

    def _write(
        self, text: str, size: int, color: Color = INK, ground: Color | None = None, **place: Any
    ) -> pygame.Rect:
        """Write a text at the place of a corner, side or the centre of its rectangle, which is returned."""
        label = words(text, size, color, ground)
        return self.sim_surface.blit(label, label.get_rect(**place))


def _reason(step: ControlStep, learned: bool) -> str:
    """Say why this model plans: the gain that was estimated, net of the price of planning.

    Algorithm 1 estimates what a step earns more, a learned value what all coming steps are worth more.
    """
    gains, model = step.highest_gains(), step.model
    if step.choice_failed:
        return f"choice failed: {model} to be safe"
    if model in gains:
        return f"switched: {'worth' if learned else 'estimated net gain'} {gains[model]:+.3f}"
    message = ", ".join(f"{name} {gain:+.3f}" for name, gain in gains.items())
    return f"stays: {'worth' if learned else 'net gain'} of {message}" if gains else "no switch considered"


def check_display() -> None:
    """Make sure that a window would be seen, unless the environment asks for a certain video driver.

    Raises:
        OSError: without a display.
    """
    driver = "dummy"
    with suppress(pygame.error):
        pygame.display.init()
        driver = pygame.display.get_driver()
    if driver in ("dummy", "offscreen") and "SDL_VIDEODRIVER" not in os.environ:
        raise OSError("there is no display for a person to drive at; use a desktop, or let a program drive")
