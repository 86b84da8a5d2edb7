"""Draw environments, with or without a window; draw texts; give human models colours;
and read the arrow keys.
"""

import os
from contextlib import suppress
from typing import Any

import matplotlib
import numpy as np
import pygame
import pygame.freetype
from highway_env.envs.common.graphics import EnvViewer
from highway_env.envs.common.observation import GrayscaleObservation
from highway_env.road.graphics import WorldSurface

from ms_highway.game.dynamics import keep_velocity, without_turns
from ms_highway.game.game import Game
from ms_highway.planning.ladders import MODELS, human_model, is_model
from ms_highway.runtime.arrays import Control, State

Color = tuple[int, ...]

MODEL_COLORS: dict[str, Color] = {
    "naive": (112, 178, 214),
    "idm": (120, 170, 90),
    "turn": (240, 180, 50),
    "tom": (214, 68, 140),
}
OTHER_COLORS = ((150, 110, 200), (160, 120, 90), (90, 150, 150))
PALEST, DARKER = (
    0.6,
    0.8,
)  # share of white without steps, and brightness of models that start from the last plan
FULL = 20  # steps from which a model has its full colour
MODEL_MEANINGS = {
    "naive": "the human keeps its velocity",
    "idm": "the human minds the car ahead",
    "turn": "the human minds only itself",
    "tom": "the human responds to the robot",
}
INK = (32, 36, 44)
FAINT = (125, 130, 140)
PAPER = (250, 250, 247)
CONE = (255, 120, 20)
GRID = (215, 218, 224)
GROUND = (205, 218, 195)
ASPHALT = (96, 100, 106)
FONT = f"{matplotlib.get_data_path()}/fonts/ttf/DejaVuSans.ttf"


def words(
    text: str, size: int, color: Color, ground: Color | None = None
) -> pygame.Surface:
    """Draw a line of text in a kerned font of ``size`` px, on a surface whose height is
    the same for every text.

    The font comes with Matplotlib, so that pictures are the same on every machine. It
    is opened for every text, as closing any of highway-env's viewers ends the font
    module.
    """
    pygame.freetype.init()
    font = pygame.freetype.Font(FONT, size)
    font.kerning = font.pad = True
    return font.render(text, color, ground)[0]


def model_color(name: str | None) -> Color:
    """Return the colour of a human model, grey without one; added models get colours in
    their order.

    A model with an effort has its own shade: fewer steps are lighter, and starting from
    the last plan is darker.
    """
    if name is None or not is_model(name):
        return FAINT
    model = human_model(name)
    base = type(model).name
    registered = [known for known in MODELS if known not in MODEL_COLORS]
    color = (
        MODEL_COLORS.get(base)
        or OTHER_COLORS[registered.index(base) % len(OTHER_COLORS)]
    )
    paler = PALEST * max(0.0, 1 - (model.steps or FULL) / FULL)
    return tuple(
        round((part + paler * (255 - part)) * (DARKER if model.warm else 1))
        for part in color
    )


def model_meaning(name: str) -> str:
    """Return in a few words what a human model expects of the human; an empty text for
    added models.
    """
    return (
        MODEL_MEANINGS.get(type(human_model(name)).name, "") if is_model(name) else ""
    )


class PictureViewer(EnvViewer):
    """Draws image observations like highway-env, also under a dummy video driver, and
    can be copied.
    """

    def __init__(self, env: Any, config: Any) -> None:
        super().__init__(env, config)
        # highway-env does not draw under a dummy video driver, but surfaces need no
        # driver
        self.enabled = True

    def __reduce__(self) -> Any:
        """Copy and pickle as a new viewer of the copied environment."""
        return type(self), (self.env, self.config)


def enable_pictures(env: Any) -> bool:
    """Give each image observation of an environment a `PictureViewer`; return whether
    one has drawn black so far.
    """
    kind = env.observation_type
    black = False
    parts = getattr(kind, "observation_types", None) or getattr(
        kind, "agents_observation_types", [kind]
    )
    for part in parts:
        if isinstance(part, GrayscaleObservation) and not isinstance(
            part.viewer, PictureViewer
        ):
            black |= not part.viewer.enabled
            part.viewer = PictureViewer(env, part.viewer.config)
    return black


class Viewer(EnvViewer):
    """Draws like highway-env, also without a display, and beside other viewers of the
    process.
    """

    # attributes that only `EnvViewer.__init__` sets
    observer_vehicle = None
    agent_surface = None
    vehicle_trajectory = None
    directory = None
    frame = 0

    def __init__(self, env: Any) -> None:
        self.env = env
        self.config = env.config
        self.offscreen = env.config["offscreen_rendering"]
        if not self.offscreen:
            try:
                super().__init__(env)
            except pygame.error as error:
                remedy = "use a desktop, or render_mode='rgb_array'"
                raise OSError(
                    "there is no display for the window of render_mode='human'"
                    f" ({error}); {remedy}"
                ) from error
        else:  # without `pygame.display`, which may fail without a screen and which surfaces do not need
            pygame.font.init()  # for labels
            size = self.config["screen_width"], self.config["screen_height"]
            self.sim_surface = WorldSurface(size, 0, pygame.Surface(size))
            self.sim_surface.scaling = self.config["scaling"]
            self.sim_surface.centering_position = self.config["centering_position"]
            if self.agent_display:
                self.extend_display()
        self.enabled = True  # as in `PictureViewer`

    def show(self, picture: pygame.Surface) -> None:
        """Show a picture in the window, if there is one, in real time if the
        configuration says so.
        """
        if not self.offscreen:
            self.screen.blit(picture, (0, 0))
            if self.env.config["real_time_rendering"]:
                self.clock.tick(self.env.config["simulation_frequency"])
            pygame.display.flip()

    def __reduce__(self) -> tuple[type[None], tuple[()]]:
        """Copy and pickle as None: a copied environment makes its own viewer when it
        renders.
        """
        return type(None), ()

    def close(self) -> None:
        """Close the window, if there is one; other environments of the process may
        still be drawing.
        """
        if not self.offscreen:
            pygame.display.quit()


def check_display() -> None:
    """Check that a window would be visible, unless the variable SDL_VIDEODRIVER names a
    video driver.

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


KEY_ACCELERATION = 4.0  # m/s^2
# rad, while a key is pressed; without one, the car returns to the direction of the road
KEY_HEADING = 0.1
HEADING_RATE = 0.4  # rad/s


class Keyboard:
    """Drives by the keyboard. It is no function of the state, as pressed keys are not
    in it.
    """

    def reset(self, key: int) -> None:
        """Nothing is remembered or drawn."""

    def __call__(self, game: Game, state: State) -> Control:
        """Return the control of car 0 for the pressed keys: up and down for speed, left
        and right for the heading.

        Raises:
            OSError: if there is no window.
        """
        check_window()
        keys = pygame.key.get_pressed()
        heading, speed = state[0, 2:]
        wanted = KEY_HEADING * (
            int(keys[pygame.K_RIGHT]) - int(keys[pygame.K_LEFT])
        )  # y points to the right
        step = float(game.world.time_step)
        turn = np.clip(
            without_turns(wanted - heading) / step, -HEADING_RATE, HEADING_RATE
        )
        pedals = KEY_ACCELERATION * (int(keys[pygame.K_UP]) - int(keys[pygame.K_DOWN]))
        return keep_velocity(game.world, state[0]) + np.array(
            [turn / max(speed, 1.0), pedals]
        )
