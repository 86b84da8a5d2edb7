"""A robot car that decides online which model of the human driver is worth its computation.

Importing the package registers its environments with Gymnasium, see `ms_highway.envs`. Cars for scenes of your own are
in `ms_highway.vehicle`, and what drives them live is in `ms_highway.controller`. The paper's ideas are
`ms_highway.human_models`, `ms_highway.switching` and, for what humans drive for, `ms_highway.irl`.
`ms_highway.experiment` runs episodes, and `ms_highway.cli` is the command.
"""

from ms_highway import interrupt

interrupt.watch()  # first of all, as what follows takes seconds

from importlib.metadata import version  # noqa: E402

from ms_highway import envs as envs  # noqa: E402

__version__ = version("ms-highway")
