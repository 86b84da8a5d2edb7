"""Let a person drive a human by the arrow keys in the environment's window."""

import numpy as np
import pygame

from ms_highway.game.dynamics import keep_velocity
from ms_highway.game.game import Game
from ms_highway.runtime.arrays import Control, State

KEY_ACCELERATION = 4.0  # m/s^2
KEY_HEADING = 0.1  # rad, while a key is pressed; without one, the car returns to the direction of the road
HEADING_RATE = 0.4  # rad/s


def keyboard_control(game: Game, state: State) -> Control:
    """Return the control of car 0 for the pressed keys: up and down for speed, left and right for the heading.

    Raises:
        OSError: if there is no window.
    """
    if not pygame.display.get_init() or pygame.display.get_surface() is None:
        raise OSError("there is no window to press keys in; make the environment with render_mode='human'")
    keys = pygame.key.get_pressed()
    heading, speed = state[0, 2:]
    wanted = KEY_HEADING * (int(keys[pygame.K_RIGHT]) - int(keys[pygame.K_LEFT]))  # y points to the right
    step = float(game.world.time_step)
    turn = np.clip((wanted - heading) / step, -HEADING_RATE, HEADING_RATE)
    pedals = KEY_ACCELERATION * (int(keys[pygame.K_UP]) - int(keys[pygame.K_DOWN]))
    return keep_velocity(game.world, state[0]) + np.array([turn / max(speed, 1.0), pedals])
