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


@pytest.mark.parametrize("scenario", ["merger", "give_way"])
def test_every_label_of_a_curve_is_inside_its_panel(scenario):
    summaries, regrets = (pd.read_csv(KEPT / f"{name}.csv") for name in ("summary", "regrets"))
    for figure in (curve(summaries[summaries["run"] == "curve"], scenario), frontier(regrets, scenario, 30)):
        figure.draw_without_rendering()
        labels = [(text.get_window_extent(), axes.get_window_extent()) for axes in figure.axes for text in axes.texts]
        assert labels
        for label, panel in labels:
            assert panel.x0 < label.x0 < label.x1 < panel.x1
            assert panel.y0 < label.y0 < label.y1 < panel.y1
