"""A section of a page: what was asked, the answer, tables and figures."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from matplotlib.figure import Figure
from rich.table import Table

from ms_highway.experiments.directory import Made


class Section(NamedTuple):
    """What a page shows of one result, beside comparisons.

    Attributes:
        title: of the section.
        asked: a question.
        answer: in a sentence or a few, with intervals where something was sampled.
        tables: all figures.
        figures: with their captions, by name; or files of films, GIFs.
        made: settings and runs of a directory of results, None where they are not known.
    """

    title: str
    asked: str
    answer: str
    tables: Sequence[Table]
    figures: Mapping[str, tuple[Figure | Path, str]]
    made: Made | None = None
