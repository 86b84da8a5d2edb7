"""Tables of texts, data frames that notebooks show as they are and commands print."""

from collections.abc import Iterable, Mapping
from string import Formatter
from typing import Any

import pandas as pd

from ms_highway.envs.registry import priced_types

NAME_WIDTH = 32  # characters, to which longer names are shortened in print

REGRETS = {
    "controller": "{controller}",
    "reward": "{reward:.2f}",
    "counted ms": "{counted_ms}",
    "meta-reward": "{meta_reward:.3f}",
    "regret": "{regret:.3f}",
    "90 % interval": "{regret_low:.3f}, {regret_high:.3f}",
}


def texts(forms: Mapping[str, str], rows: Iterable[Mapping[Any, Any]]) -> pd.DataFrame:
    """Return the texts of a table.

    A text is empty where a value is missing, None or NaN. Columns that are empty in all rows are left out.

    Args:
        forms: by heading, format strings of the values' names.
        rows: values by name.
    """

    def text(form: str, row: Mapping[Any, Any]) -> str:
        names = [name for _, name, _, _ in Formatter().parse(form) if name]
        return form.format(**row) if all(pd.notna(row.get(name)) for name in names) else ""

    table = pd.DataFrame([{heading: text(form, row) for heading, form in forms.items()} for row in rows])
    return table.loc[:, (table != "").any()]


def grid(title: str, rows: Any, names: int = 1) -> pd.DataFrame:
    """Return a table with a title in its ``attrs``.

    Args:
        title: of the table.
        rows: a data frame of texts, or a mapping by heading for each row.
        names: how many of the first columns are names.
    """
    table = pd.DataFrame(rows).fillna("")
    table = table.set_index(list(table.columns[:names]))
    table.attrs["title"] = title
    return table


def printed(table: pd.DataFrame, width: int) -> str:
    """Return a table of `grid` as text of a width; columns that find no room follow below, beside the same names."""
    shown = table.rename(index=lambda name: name if len(name) <= NAME_WIDTH else f"{name[:15]}…{name[-16:]}")
    text = shown.to_string(line_width=width, sparsify=False)
    return "\n".join([table.attrs["title"], *(line.rstrip() for line in text.splitlines()), ""])


def two_digits(value: float) -> str | None:
    """Return a number of at most two significant digits below 10, and without decimals from there on; None of NaN."""
    if pd.isna(value):
        return None
    return f"{value:.2g}" if abs(value) < 10 else f"{value:.0f}"


def regret_tables(behind: pd.DataFrame, scenario: str) -> list[pd.DataFrame]:
    """Return regrets per step in one scenario, a table per price; of controllers with a lambda, the best of each kind.

    Args:
        behind: rows of `ms_highway.experiments.frontier.regrets`, with columns ``scenario`` and ``price``.
        scenario: its name.
    """
    tables = []
    for price, rows in behind.query("scenario == @scenario").groupby("price", sort=False):
        ranked = rows.assign(counted_ms=(1e3 * rows["counted_seconds"]).map(two_digits)).sort_values("regret")
        shown = ranked[~(ranked["kind"].isin(priced_types()) & ranked.duplicated("kind"))]
        title = f"{scenario}, a second of planning costs {price:g}; of each kind with a lambda, the best"
        tables.append(grid(title, texts(REGRETS, shown.to_dict("records"))))
    return tables
