"""A section of a page: what was asked, the answer, tables and figures."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from matplotlib.figure import Figure
from rich.table import Table


class Section(NamedTuple):
    """What a page shows of one result, beside comparisons.

    Attributes:
        title: of the section.
        asked: a question.
        answer: in a sentence or a few, with intervals where something was sampled.
        tables: all figures.
        figures: with their captions, by name; or files of films, GIFs.
        directory: of results, whose settings and commands the page tells.
    """

    title: str
    asked: str
    answer: str
    tables: Sequence[Table]
    figures: Mapping[str, tuple[Figure | Path, str]]
    directory: Path | None = None
