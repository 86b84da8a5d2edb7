"""The page that is made of a comparison, and every figure in every format of its files."""

import io
import json
import re
import shutil
from base64 import b64decode
from html import unescape
from importlib.metadata import version
from pathlib import Path
from xml.etree import ElementTree

import imageio.v3 as imageio
import pandas as pd
import pytest
from commands import run

from ms_highway.cli.options import FORMATS
from ms_highway.experiments.results import read_results
from ms_highway.visualization.figures import CAPTIONS, figures
from ms_highway.visualization.style import content
from ms_highway.visualization.tradeoff import curve, frontier

KEPT = Path(__file__).parents[2] / "notebooks" / "results"
CONTROLLERS = ["naive", "switching:0.4"]
COMPARE = "compare stay_back --controllers naive switching:0.4 --out"


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """A comparison of which one episode was run first, and the rest later."""
    directory = tmp_path_factory.mktemp("compare")
    for seeds in (1, 2):
        run(f"{COMPARE} {directory} --seeds {seeds}")
    return directory


@pytest.fixture(scope="module")
def html(compared):
    run(f"report {compared}")
    return (compared / "report.html").read_text()


def texts_of(html):
    """What a page shows besides pictures, piece by piece."""
    return [unescape(text).strip() for text in re.split("<[^>]*>", html)]


def elements(html, tag):
    """The attributes of all elements of a kind."""
    return [dict(re.findall(r'([\w-]+)="([^"]*)"', found)) for found in re.findall(f"<{tag} [^>]*>", html)]


def data(source, kind):
    assert source.startswith(f"data:{kind};base64,")
    return b64decode(source.partition(",")[2])


def test_the_page_has_answer_table_figures_film_and_settings(html, compared):
    texts = texts_of(html)
    said = " ".join(texts)
    summary = pd.read_csv(compared / "summary.csv").set_index("controller")
    assert f"naive earns a reward of {summary.loc['naive', 'reward']:.2f} per step" in said
    for name in CONTROLLERS:
        assert re.search(rf">{name}</t[hd]>\s*<td>{summary.loc[name, 'reward']:.2f}</td>", html)
    images, (film,) = elements(html, "img"), elements(html, "video")
    names = [image["alt"].split(".")[0] for image in images]
    assert names == [f"Stay Back, {name}" for name in ("bars", "timeline", "decisions")]
    for image in images:
        assert imageio.imread(data(image["src"], "image/png")).std() > 10
    assert "naive above, switching:0.4 below" in film["aria-label"]
    frames = imageio.imread(data(film["src"], "video/mp4"), plugin="pyav", extension=".mp4")
    assert frames.shape == (35, 816, 960, 3)
    assert f"ms-highway compare stay_back --controllers naive switching:0.4 --out {compared} --seeds 1" in said
    assert f"jax {version('jax')}" in said
    assert {"human reward", "learned"} <= set(texts)
    assert "are missing" not in said


def test_the_page_refers_to_nothing_outside_itself(html):
    assert not any(text in html for text in ("http:", "https:", "url(", "@import"))
    for place in re.findall(r'\b(?:src|href)="([^"]*)"', html):
        assert place.startswith(("data:", "#"))


def test_a_page_of_a_stopped_comparison_says_what_is_missing_and_shows_no_markup_of_others(compared, tmp_path, capsys):
    directory, out = tmp_path / "stopped", tmp_path / "pages" / "small.html"
    shutil.copytree(compared, directory)
    records = pd.read_csv(directory / "steps.csv")
    records[(records["controller"] == "naive") & (records["seed"] == 0)].to_csv(directory / "steps.csv", index=False)
    runs = json.loads((directory / "provenance.json").read_text())
    (directory / "provenance.json").write_text(json.dumps([runs[0] | {"command": "<script>alert(1)</script>"}]))
    run(f"report {directory} --no-videos --out {out}")
    assert "lacks 3 episodes; start the same" in capsys.readouterr().err
    html = out.read_text()
    assert "3 of the requested episodes are missing." in texts_of(html)
    assert "<script>alert(1)</script>" in unescape(html)
    assert not elements(html, "video")
    assert "<script" not in html
    assert [path.name for path in out.parent.iterdir()] == [out.name]


def test_provenance_grows_when_a_comparison_goes_on_and_only_then(compared):
    runs = json.loads((compared / "provenance.json").read_text())
    assert [run["command"][-1] for run in runs] == ["1", "2"]
    assert runs[0]["versions"]["highway-env"] == version("highway-env")
    run(f"{COMPARE} {compared} --seeds 2")
    assert json.loads((compared / "provenance.json").read_text()) == runs


@pytest.fixture(scope="module")
def drawn(compared):
    """A figure of each kind, by its name."""
    results = read_results(compared)
    summaries, regrets = (pd.read_csv(KEPT / f"{name}.csv") for name in ("summary", "regrets"))
    return {
        **{name: draw() for name, draw in figures(results.records, results.summaries, "stay_back").items()},
        "curve": curve(summaries[summaries["run"] == "curve"], "merger"),
        "frontier": frontier(regrets, "merger", 30),
    }


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("name", [*CAPTIONS, "frontier"])
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
