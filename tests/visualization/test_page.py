"""The page that is made of a comparison."""

import json
from base64 import b64decode
from dataclasses import replace
from importlib.metadata import version

import imageio.v3 as imageio
import pandas as pd
import pytest
from commands import run
from comparisons import CONTROLLERS, Page, with_settings

from ms_highway.experiments.results import read_results
from ms_highway.visualization.html_page import results_table


@pytest.fixture(scope="module")
def html(compared):
    run(f"report {compared}")
    return (compared / "report.html").read_text()


def content(source, kind):
    assert source.startswith(f"data:{kind};base64,")
    return b64decode(source.partition(",")[2])


def test_the_page_has_answer_table_figures_film_and_settings(html, compared):
    shown = Page(html)
    said = " ".join(shown.texts)
    summary = pd.read_csv(compared / "summary.csv").set_index("controller")
    assert f"naive earns a reward of {summary.loc['naive', 'reward']:.2f} per step" in said
    for name in CONTROLLERS:
        row = shown.texts.index(name, shown.texts.index("controller"))
        assert shown.texts[row + 1] == f"{summary.loc[name, 'reward']:.2f}"
    figures = [image["alt"].split(".")[0] for image in shown.all("img")]
    assert figures == [f"Stay Back, {name}" for name in ("bars", "timeline", "decisions")]
    for image in shown.all("img"):
        assert imageio.imread(content(image["src"], "image/png")).std() > 10
    (film,) = shown.all("video")
    assert "naive above, switching:0.4 below" in film["aria-label"]
    frames = imageio.imread(content(film["src"], "video/mp4"), plugin="pyav", extension=".mp4")
    assert frames.shape == (35, 816, 960, 3)
    assert f"ms-highway compare stay_back --controllers naive switching:0.4 --out {compared} --seeds 1" in said
    assert f"jax {version('jax')}" in said
    assert {"human reward", "learned"} <= set(shown.texts)
    assert "are missing" not in said


def test_the_page_refers_to_nothing_outside_itself(html):
    assert not any(text in html for text in ("http:", "https:", "url(", "@import"))
    for _, attributes in Page(html).elements:
        for name in ("src", "href"):
            assert attributes.get(name, "#").startswith(("data:", "#"))


def test_a_page_of_a_stopped_comparison_says_what_is_missing_and_shows_no_markup_of_others(compared, tmp_path, capsys):
    directory, out = with_settings(compared, tmp_path / "stopped"), tmp_path / "pages" / "small.html"
    records = pd.read_csv(directory / "steps.csv")
    records[(records["controller"] == "naive") & (records["seed"] == 0)].to_csv(directory / "steps.csv", index=False)
    runs = json.loads((directory / "provenance.json").read_text())
    (directory / "provenance.json").write_text(json.dumps([runs[0] | {"command": "<script>alert(1)</script>"}]))
    run(f"report {directory} --no-videos --out {out}")
    assert "lacks 3 episodes; start the same" in capsys.readouterr().err
    shown = Page(out.read_text())
    assert "3 of the requested episodes are missing." in shown.texts
    assert "<script>alert(1)</script>" in shown.texts
    assert not shown.all("script") + shown.all("video")
    assert [path.name for path in out.parent.iterdir()] == [out.name]


def test_what_the_paper_published_stands_beside_what_may_be_compared_with_it_only(compared):
    results = read_results(compared)
    released = results.settings | {"semantics": "released", "human_reward": "published"}
    assert results_table(replace(results, settings=released), "stay_back")["published"].tolist() == ["-7.73", "2.59"]
    for change in ({"semantics": "paper"}, {"human_reward": "learned"}, {"costs": "measured"}, {"horizon": 5}):
        assert "published" not in results_table(replace(results, settings=released | change), "stay_back")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("elsewhere", "there is no directory elsewhere; name a directory that `ms-highway compare` wrote"),
        ("{} --out page.pdf", "'page.pdf' is no name that ends in .html"),
    ],
)
def test_a_page_that_cannot_be_is_refused_in_one_line(words, message, compared, refused):
    assert message in refused(f"report {words.format(compared, compared)}".strip())
