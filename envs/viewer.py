"""Draw environments, with or without a window, and draw texts."""

import matplotlib
import pygame
import pygame.freetype
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.graphics import EnvViewer
from highway_env.envs.common.observation import GrayscaleObservation
from highway_env.road.graphics import WorldSurface

from ms_highway.envs.colors import Color
from ms_highway.envs.configuration import Config


def words(
    text: str,
    size: int,
    color: Color,
    ground: Color | None = None,
) -> pygame.Surface:
    """Draw a line of text in a kerned font of ``size`` px.

    The height of the surface is the same for every text. The font comes with
    Matplotlib, so that pictures are the same on every machine. It is opened for every
    text, as closing any of highway-env's viewers ends the font module.
    """
    file = f"{matplotlib.get_data_path()}/fonts/ttf/DejaVuSans.ttf"
    pygame.freetype.init()
    font = pygame.freetype.Font(file, size)
    font.kerning = font.pad = True
    return font.render(text, color, ground)[0]


class PictureViewer(EnvViewer):
    """Draws image observations like highway-env, and can be copied.

    It also draws under a dummy video driver.
    """

    def __init__(self, env: AbstractEnv, config: Config) -> None:
        super().__init__(env, config)
        # highway-env does not draw under a dummy video driver, but surfaces need none.
        self.enabled = True

    def __reduce__(self) -> tuple[type, tuple[AbstractEnv, Config]]:
        """Copy and pickle as a new viewer of the copied environment."""
        return type(self), (self.env, self.config)


def enable_pictures(env: AbstractEnv) -> bool:
    """Give each image observation of an environment a `PictureViewer`.

    Return whether one has drawn black so far.
    """
    kind = env.observation_type
    parts = getattr(kind, "observation_types", None)
    if not parts:
        parts = getattr(kind, "agents_observation_types", [kind])
    black = False
    for part in parts:
        if not isinstance(part, GrayscaleObservation):
            continue
        if not isinstance(part.viewer, PictureViewer):
            black |= not part.viewer.enabled
            part.viewer = PictureViewer(env, part.viewer.config)
    return black


class Viewer(EnvViewer):
    """Draws like highway-env, also without a display.

    Other viewers of the process may draw at the same time.
    """

    # Attributes that only `EnvViewer.__init__` sets.
    observer_vehicle = None
    agent_surface = None
    vehicle_trajectory = None
    directory = None
    frame = 0

    def __init__(self, env: AbstractEnv) -> None:
        self.env = env
        self.config = env.config
        self.offscreen = env.config["offscreen_rendering"]
        if self.offscreen:
            self._make_surface()
        else:
            try:
                super().__init__(env)
            except pygame.error as error:
                remedy = "use a desktop, or render_mode='rgb_array'"
                raise OSError(
                    "there is no display for the window of render_mode='human'"
                    f" ({error}); {remedy}"
                ) from error
        self.enabled = True  # as in `PictureViewer`

    def _make_surface(self) -> None:
        """Make the surface without `pygame.display`.

        That may fail without a screen, and surfaces do not need it.
        """
        pygame.font.init()  # for labels
        size = self.config["screen_width"], self.config["screen_height"]
        self.sim_surface = WorldSurface(size, 0, pygame.Surface(size))
        self.sim_surface.scaling = self.config["scaling"]
        self.sim_surface.centering_position = self.config["centering_position"]
        if self.agent_display:
            self.extend_display()

    def show(self, picture: pygame.Surface) -> None:
        """Show a picture in the window, if there is one.

        It is shown in real time if the configuration says so.
        """
        if not self.offscreen:
            self.screen.blit(picture, (0, 0))
            if self.env.config["real_time_rendering"]:
                self.clock.tick(self.env.config["simulation_frequency"])
            pygame.display.flip()

    def __reduce__(self) -> tuple[type[None], tuple[()]]:
        """Copy and pickle as None.

        A copied environment makes its own viewer when it renders.
        """
        return type(None), ()

    def close(self) -> None:
        """Close the window, if there is one.

        Other environments of the process may still be drawing.
        """
        if not self.offscreen:
            pygame.display.quit()
