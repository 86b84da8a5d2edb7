"""Annotations are true: types and shapes of all arguments and results are checked."""

from pathlib import Path

import pytest
from commands import python

SCRIPT = Path(__file__).parents[1] / "typechecked.py"


def test_annotations_hold_while_a_robot_drives():
    python(str(SCRIPT), "game")


@pytest.mark.slow
@pytest.mark.parametrize(
    "scene", ["physical", "several", "stock", "batch", "prediction"]
)
def test_annotations_hold_in_every_kind_of_scene(scene):
    python(str(SCRIPT), scene)
