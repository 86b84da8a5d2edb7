"""Every figure, in every format of its files."""

import io
import re
from pathlib import Path
from xml.etree import ElementTree

import imageio.v3 as imageio
import pandas as pd
import pytest

from ms_highway.cli.options import FORMATS
from ms_highway.experiments.results import read_results
from ms_highway.visualization.figures import CAPTIONS, content, figures
from ms_highway.visualization.roads import success_figure
from ms_highway.visualization.tradeoff import curve, frontier

KEPT = Path(__file__).parents[2] / "notebooks" / "results"
DRIVER = {"success": 0.5, "episodes": 20}


@pytest.fixture(scope="module")
def drawn(compared):
    """A figure of each kind, by its name; those of predictions are drawn in another file."""
    results, (summaries, regrets) = (
        read_results(compared),
        map(pd.read_csv, (KEPT / "summary.csv", KEPT / "regrets.csv")),
    )
    return {
        **{name: draw() for name, draw in figures(results.records, results.summaries, "stay_back").items()},
        "curve": curve(summaries[summaries["run"] == "curve"], "merger"),
        "frontier": frontier(regrets, "merger", 30),
        "success": success_figure({"merge-v1": {"priced": DRIVER, "idm": DRIVER}}),
    }


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("name", [*CAPTIONS, "frontier", "success"])
def test_every_figure_is_written_in_every_format_and_shows_something(name, kind, drawn):
    written = content(drawn[name], kind)
    if kind == "png":
        assert imageio.imread(io.BytesIO(written)).std() > 10
    elif kind == "svg":
        assert len(list(ElementTree.fromstring(written).iter("{http://www.w3.org/2000/svg}path"))) > 20
    else:
        assert written.startswith(b"%PDF")
        assert len(written) > 8000
        assert not re.search(rb"/Type3\b", written)  # fonts that publishers refuse
