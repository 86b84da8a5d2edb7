"""Tables of texts, to be printed or written."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, zip_longest
from re import search
from string import Formatter
from textwrap import wrap
from typing import Any

import pandas as pd

from ms_highway.experiments.analysis.regret import remarks

HEADING_WIDTH, NAME_WIDTH = 6, 32  # characters, after which headings of narrow columns and long names are wrapped
SHORT_NAME_WIDTH = 13  # characters, to which names are wrapped where there is no room
PAGE_WIDTH = 120  # characters
GAP = "  "  # between columns

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
    """Format values as usual, and with ``:two`` to two significant digits."""

    def format_field(self, value: Any, format_spec: str) -> str:
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
            found = _Cells().vformat(form, (), row)
        except (LookupError, TypeError):
            return ""
        return "" if search(r"\bnan\b|\bNone\b", found) else found

    found = [{heading: text(form, row) for heading, form in forms.items()} for row in rows]
    return [{heading: row[heading] for heading in forms if any(each[heading] for each in found)} for row in found]


@dataclass(frozen=True, repr=False)
class Table:
    """A table to be printed.

    Attributes:
        title: above it.
        rows: texts by heading, the same headings in each.
        names: how many of the first columns are names, which may be wrapped; all others are numbers, flush right.
        caption: below it.
    """

    title: str
    rows: Sequence[Mapping[str, str]]
    names: int = 1
    caption: str = ""

    def __repr__(self) -> str:
        """Return the table as it is on a page."""
        return "\n".join(self.lines(PAGE_WIDTH))

    def lines(self, width: int, bold: str = "{}") -> list[str]:
        """Return the lines of the table, which fit a terminal of this width [characters].

        Where that is too narrow, names are wrapped, and numbers stand in several tables, each beside the names.

        Args:
            width: of the terminal.
            bold: the form of titles and headings.
        """
        headings = {heading: heading.replace("/step", " /step") for heading in self.rows[0]}
        names, numbers = list(headings)[: self.names], list(headings)[self.names :]
        widths = {name: _width(heading, [row[name] for row in self.rows]) for name, heading in headings.items()}
        widths |= {name: min(NAME_WIDTH, max(len(row[name]) for row in [*self.rows, {name: name}])) for name in names}
        least = sum(min(SHORT_NAME_WIDTH, widths[name]) + len(GAP) for name in names)
        parts: list[list[str]] = [[]]
        for number in numbers:
            if parts[-1] and least + sum(widths[each] + len(GAP) for each in [*parts[-1], number]) > width:
                parts.append([])
            parts[-1].append(number)
        lines = [bold.format(self.title), ""]
        for part in parts:
            excess = sum(widths[each] + len(GAP) for each in (*names, *part)) - width
            shown = {heading: widths[heading] for heading in (*names, *part)}
            for name in reversed(names):
                cut = max(0, min(excess, shown[name] - SHORT_NAME_WIDTH))
                shown[name], excess = shown[name] - cut, excess - cut
            head = [bold.format(line) for line in self._lines_of(headings, shown)]
            rule = "-" * (sum(shown.values()) + len(GAP) * (len(shown) - 1))
            lines += [*head, rule, *chain(*(self._lines_of(row, shown) for row in self.rows)), ""]
        return [*lines, self.caption, ""] if self.caption else lines

    def _lines_of(self, row: Mapping[str, str], widths: Mapping[str, int]) -> list[str]:
        """Return the lines of a row in columns of these widths, the first of which are names."""
        cells = [_wrapped(row[heading], width) for heading, width in widths.items()]
        return [
            GAP.join(
                text.ljust(width) if place < self.names else text.rjust(width)
                for place, (text, width) in enumerate(zip(line, widths.values(), strict=True))
            ).rstrip()
            for line in zip_longest(*cells, fillvalue="")
        ]


def _wrapped(text: str, width: int) -> list[str]:
    return wrap(text, width) or [""]


def _width(heading: str, texts: Sequence[str]) -> int:
    """Return the width of a column whose heading is wrapped between words and whose texts are not."""
    longest = max(map(len, texts))
    lines = wrap(heading, max(longest, HEADING_WIDTH), break_long_words=False)
    return max([longest, *map(len, lines)])


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
        own = rows.query("scenario == @scenario").assign(counted_ms=1e3 * rows["counted_seconds"])
        shown = own.assign(remark=own["controller"].map(said)).set_index("controller", drop=False).loc[list(said)]
        title = f"{scenario}, a second of planning costs {price:g}"
        tables.append(Table(title, texts(REGRETS, shown.to_dict("records")), 2))
    return tables
