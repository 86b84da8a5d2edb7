"""Let a person drive by the arrow keys, in a window that the person can see."""

import os
from contextlib import suppress

import numpy as np
import pygame

from ms_highway.game.dynamics import keep_velocity, without_turns
from ms_highway.game.game import Game
from ms_highway.runtime.arrays import Control, State


def check_display() -> None:
    """Check that a window would be visible.

    Nothing is checked if the variable SDL_VIDEODRIVER names a video driver.

    Raises:
        OSError: without a display.
    """
    driver = "dummy"
    with suppress(pygame.error):
        pygame.display.init()
        driver = pygame.display.get_driver()
    if driver in ("dummy", "offscreen") and "SDL_VIDEODRIVER" not in os.environ:
        raise OSError(
            "there is no display for a person to drive at; use a desktop, or let a"
            " program drive"
        )


def check_window(render_mode: str | None = None) -> None:
    """Check that there is, or will be, a window whose keys a person can press.

    Args:
        render_mode: of the environment that is to open it, which only ``"human"`` does;
            by default, it is open.

    Raises:
        OSError: without a display, or without a window.
    """
    if render_mode == "human":
        check_display()
    elif not pygame.display.get_init() or pygame.display.get_surface() is None:
        raise OSError(
            "there is no window to press keys in; make the environment with"
            " render_mode='human'"
        )


class Keyboard:
    """Drives by the keyboard.

    It is no function of the state, as pressed keys are not in it.

    Attributes:
        name: of this human driver in configurations.
        acceleration: while a key is pressed [m/s^2].
        heading: while a key is pressed [rad]; without one, the car returns to the
            direction of the road.
        heading_rate: at which the heading changes at most [rad/s].
    """

    name = "keyboard"
    acceleration = 4.0
    heading = 0.1
    heading_rate = 0.4

    def reset(self, key: int) -> None:
        """Nothing is remembered or drawn."""

    def __call__(self, game: Game, state: State) -> Control:
        """Return the control of car 0 for the pressed keys.

        Up and down are for speed, left and right for the heading.

        Raises:
            OSError: if there is no window.
        """
        check_window()
        keys = pygame.key.get_pressed()
        heading, speed = state[0, 2:]

        # Turn to the wanted heading; y points to the right.
        right = int(keys[pygame.K_RIGHT]) - int(keys[pygame.K_LEFT])
        change = without_turns(self.heading * right - heading)
        rate = change / float(game.world.time_step)
        turn = np.clip(rate, -self.heading_rate, self.heading_rate)

        forward = int(keys[pygame.K_UP]) - int(keys[pygame.K_DOWN])
        asked = np.array([turn / max(speed, 1.0), self.acceleration * forward])
        return keep_velocity(game.world, state[0]) + asked
