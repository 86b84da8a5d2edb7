"""What a person sees of a robot among several humans: who is predicted how, and what that costs."""

from math import inf
from typing import Any

import pygame

from ms_highway.control.fallback import PLANNED, STATUSES
from ms_highway.envs.graphics import FAINT, GRID, INK, MARGIN, PAPER, TEXT_WIDTH, InteractionViewer, model_color, words
from ms_highway.planning.crowd import NAIVE, RUNGS

__all__ = ["CrowdViewer"]

LARGE, MEDIUM, SMALL = 22, 15, 13  # px, sizes of texts
DOT = 2  # px, radius
ROOF = 11  # px, radius of what a number is written on
EVERY = 2  # step of a predicted path of which a dot is drawn
BAR = pygame.Rect(MARGIN, 0, TEXT_WIDTH - 5 * MARGIN, 14)  # of the step's time
ROOM = 1.25  # of the bar in budgets, or in the longest times without one


class CrowdViewer(InteractionViewer):
    """Draws an `ms_highway.envs.crowd.base.CrowdEnv`.

    Every human has the colour of the model that predicts it, and its predicted path is drawn as dots of that colour.
    """

    panel_height = 190  # px

    def display(self) -> None:
        """Draw everything."""
        for human, rung in zip(self.env.road.vehicles[1:], self._rungs(), strict=False):
            human.color = model_color(rung)
        super().display()

    def _rungs(self) -> tuple[str, ...]:
        """Return the names of the models of the last step, the cheapest before the first."""
        history = self.env.history
        shown = history[-1]["rungs"] if history else ()  # none where the agent drives
        return shown or (RUNGS[NAIVE],) * self.env.settings.humans

    def _names(self) -> None:
        """Draw the robot's name at the roadside, and every human's number on its roof."""
        surface = self.sim_surface
        self._name("robot", self.env.robot, 1)
        for number, (human, rung) in enumerate(zip(self.env.road.vehicles[1:], self._rungs(), strict=True), start=1):
            place = surface.vec2pix(human.position)
            label = words(str(number), MEDIUM, INK)
            pygame.draw.circle(surface, model_color(rung), place, ROOF)
            surface.blit(label, label.get_rect(center=place))

    def _plans(self) -> None:
        """Draw the predicted paths of humans as dots in the colours of their models, and the robot's plan as a line."""
        robot, surface = self.env.robot, self.sim_surface
        if robot.last_step is None:
            return
        for state, controls, rung in zip(robot.last_state[1:], robot.last_step.humans, self._rungs(), strict=True):
            for point in self._path(state, controls)[EVERY::EVERY]:
                pygame.draw.circle(surface, PAPER, surface.vec2pix(point), DOT + 1)
                pygame.draw.circle(surface, model_color(rung), surface.vec2pix(point), DOT)
        self._line(self._path(robot.last_state[0], robot.last_step.plan), tuple(robot.color))

    def _now(self, record: dict[str, Any], top: int) -> None:
        """Draw the left part: how many humans each model predicts, the step's time and reward."""
        line = f"step {len(self.env.history)}    reward {record['reward']:+.2f}"
        line += "    COLLISION" if record["collision"] else "    in the target lane" if self.env.success else ""
        if not record["rungs"]:
            self._text("the agent drives", LARGE, INK, (MARGIN, top))
        else:
            left = MARGIN
            for rung in RUNGS:
                left = self._chip(f"{rung} {record['rungs'].count(rung)}", rung, left, top)
            self._time(record, top + 58)
        self._text(line, MEDIUM, INK, (MARGIN, top + 100))
        cones, status = self.env.distance_to_cones, record["status"]
        lines = [f"cones in {cones:.0f} m"] if cones < inf else []
        lines += [status] if status not in (None, STATUSES[PLANNED]) else []
        self._text("    ".join(lines), MEDIUM, INK, (MARGIN, top + 126))
        self._beliefs(record, top + 151)

    def _beliefs(self, record: dict[str, Any], top: int) -> None:
        """Draw the probabilities of the models of every human, behind its number, or below it where room is short."""
        if record["belief"] is None:
            return
        width, number = BAR.width // len(record["belief"]), words("12", SMALL, INK).get_width() + 3
        for place, shares in enumerate(record["belief"]):
            left = BAR.left + place * width
            below = pygame.Rect(left, top + 16, width - 6, 8)
            behind = pygame.Rect(left + number, top, width - number - 6, 17)
            self._text(str(place + 1), SMALL, INK, (left, top))
            self._belief(behind if behind.width > number else below, shares)

    def _chip(self, text: str, rung: str, left: int, top: int) -> int:
        """Draw a text on the colour of a model; return where the next one begins."""
        name = words(text, LARGE, PAPER)
        chip = pygame.Rect(left, top, name.get_width() + 2 * MARGIN, 34)
        pygame.draw.rect(self.sim_surface, model_color(rung), chip, border_radius=8)
        self.sim_surface.blit(name, name.get_rect(center=chip.center))
        return chip.right + 8

    def _time(self, record: dict[str, Any], top: int) -> None:
        """Draw the time of planning and, paler, of deciding as a bar, with a line at the budget."""
        surface, budget = self.sim_surface, self.env.budget
        planning, deciding = record["planning_seconds"], record["decision_seconds"]
        longest = max(each["planning_seconds"] + each["decision_seconds"] for each in self.env.history)
        text = f"planning {1e3 * planning:.1f} ms, deciding {1e3 * deciding:.1f} ms"
        text += "" if budget is None else f", budget {1e3 * budget:g} ms"
        self._text(text, MEDIUM, INK, (MARGIN, top - 18))
        bar = BAR.move(0, top + 4)
        pygame.draw.rect(surface, GRID, bar)
        scale = bar.width / max(longest, ROOM * (budget or 0.0), 1e-6)
        split, end = (bar.left + round(scale * seconds) for seconds in (planning, planning + deciding))
        pygame.draw.rect(surface, model_color(record["model"]), (bar.left, bar.top, split - bar.left, bar.height))
        pygame.draw.rect(surface, FAINT, (split, bar.top, end - split, bar.height))
        if budget is not None:
            place = bar.left + round(scale * budget)
            pygame.draw.line(surface, INK, (place, bar.top - 3), (place, bar.bottom + 2), 2)

    def _bars(self, box: pygame.Rect) -> None:
        """Draw a stacked bar per step: how many humans each model predicts, the dearest at the bottom."""
        width, history, humans = self._step_width(box), self.env.history, self.env.settings.humans
        for place, record in enumerate(history):
            left, bottom = round(box.left + place * width), box.bottom
            for rung in reversed(RUNGS):
                height = round(box.height * record["rungs"].count(rung) / humans)
                bar = (left, bottom - height, max(1, round(width) - 1), height)
                pygame.draw.rect(self.sim_surface, model_color(rung), bar)
                bottom -= height
        self._chart(box, "humans that each model predicts", "0", str(humans))
