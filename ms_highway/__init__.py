"""A robot car that decides online which model of the human driver is worth its computation.

Importing the package registers its environments with Gymnasium, see `ms_highway.envs`.
"""

from importlib.metadata import version

from ms_highway import envs as envs

__version__ = version("ms-highway")
