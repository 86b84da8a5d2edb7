"""Tables of texts, to be printed or written."""

from collections.abc import Iterable, Iterator, Mapping
from copy import copy
from string import Formatter
from textwrap import wrap
from typing import Any

import pandas as pd
from rich.box import SIMPLE
from rich.table import Column, Table

from ms_highway.experiments.analysis.regret import remarks

HEADING_WIDTH, NAME_WIDTH = 6, 32  # characters, after which headings of narrow columns and long names are wrapped
SHORT_NAME_WIDTH = 13  # characters, to which names are wrapped where there is no room
GAP = 2  # characters between columns

REGRETS = {
    "controller": "{controller}",
    "": "{remark}",
    "reward": "{reward:.2f}",
    "counted ms": "{counted_ms:two}",
    "meta-reward": "{meta_reward:.3f}",
    "regret": "{regret:.3f}",
    "90 % interval": "{regret_low:.3f}, {regret_high:.3f}",
}


class _Cells(Formatter):
    """Format values as usual, and with ``:two`` to two significant digits.

    Raises:
        TypeError: for a missing value, None or NaN.
    """

    def format_field(self, value: Any, format_spec: str) -> str:
        if pd.api.types.is_scalar(value) and pd.isna(value):
            raise TypeError("the value is missing")
        return two_digits(value) if format_spec == "two" else super().format_field(value, format_spec)


def texts(forms: Mapping[str, str], rows: Iterable[Mapping[str, Any]]) -> list[dict[str, str]]:
    """Return the texts of a table, a dictionary by heading for each row.

    A text is empty where a value is missing, None or NaN. Columns that are empty in all rows are left out.

    Args:
        forms: by heading, format strings of the values' names, in which ``:two`` stands for two significant digits.
        rows: values by name.
    """

    def text(form: str, row: Mapping[str, Any]) -> str:
        try:
            return _Cells().vformat(form, (), row)
        except (LookupError, TypeError):
            return ""

    found = [{heading: text(form, row) for heading, form in forms.items()} for row in rows]
    return [{heading: row[heading] for heading in forms if any(each[heading] for each in found)} for row in found]


def grid(title: str, rows: Iterable[Mapping[Any, str]], left: int = 1) -> Table:
    """Return a table to be printed.

    Args:
        title: above it.
        rows: texts by heading, the same headings in each.
        left: how many of the first columns are names; all others are numbers, flush right.
    """
    cells = list(rows)
    table = Table(title=title, box=SIMPLE, title_style="bold", collapse_padding=True, pad_edge=False)
    table.title_justify = table.caption_justify = "left"
    for place, heading in enumerate(cells[0]):
        width = max(HEADING_WIDTH, *(len(row[heading]) for row in cells))
        lines = wrap(heading.replace("/step", " /step"), width, break_long_words=False)
        if place < left:
            least = min(width, SHORT_NAME_WIDTH)
            table.add_column("\n".join(lines), overflow="fold", min_width=least, max_width=NAME_WIDTH)
        else:
            least = max(len(text) for text in (*lines, *(row[heading] for row in cells)))
            table.add_column("\n".join(lines), justify="right", no_wrap=True, min_width=least)
    for row in cells:
        table.add_row(*row.values())
    return table


def fitting(table: Table, width: int) -> Iterator[Table]:
    """Yield a table, or where a terminal is too narrow, its columns in several tables, each with those of the names."""
    names = [column for column in table.columns if column.justify == "left"]
    parts: list[list[Column]] = [[]]
    for column in table.columns[len(names) :]:
        if parts[-1] and sum(GAP + (each.min_width or 0) for each in (*names, *parts[-1], column)) > width:
            parts.append([])
        parts[-1].append(column)
    for part in parts:
        own = copy(table)
        own.columns = names + part
        own.title = table.title if part is parts[0] else None
        own.caption = table.caption if part is parts[-1] else None
        yield own


def two_digits(value: float) -> str:
    """Return a number of at most two significant digits below 10, and without decimals from there on."""
    return f"{value:.2g}" if abs(value) < 10 else f"{value:.0f}"


def regret_tables(behind: pd.DataFrame, scenario: str) -> list[Table]:
    """Return regrets per step in one scenario, a table per price, of the controllers that `remarks` selects.

    Args:
        behind: rows of `ms_highway.experiments.analysis.regret.regrets`, with columns ``scenario`` and ``price``.
        scenario: its name.
    """
    tables = []
    for price, rows in behind.groupby("price", sort=False):
        said = remarks(rows, scenario, price)
        own = rows.query("scenario == @scenario")
        own = own.assign(counted_ms=1e3 * own["counted_seconds"])
        shown = own.assign(remark=own["controller"].map(said)).set_index("controller", drop=False).loc[list(said)]
        title = f"{scenario}, a second of planning costs {price:g}"
        tables.append(grid(title, texts(REGRETS, shown.to_dict("records")), 2))
    return tables
