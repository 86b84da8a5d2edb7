"""The page that is made of a comparison."""

import json
from base64 import b64decode
from dataclasses import replace
from importlib.metadata import version

import imageio.v3 as imageio
import numpy as np
import pandas as pd
import pytest
from commands import run
from comparisons import CONTROLLERS, Page, with_settings

from ms_highway.experiments.results import read_results
from ms_highway.visualization.html_page import results_table
from ms_highway.visualization.video import film


@pytest.fixture(scope="module")
def html(compared):
    run(f"report {compared}")
    return (compared / "report.html").read_text()


def content(source, kind):
    assert source.startswith(f"data:{kind};base64,")
    return b64decode(source.partition(",")[2])


def test_the_page_has_answer_table_figures_film_and_settings(html, compared):
    page = Page(html)
    said = " ".join(page.texts)
    summary = pd.read_csv(compared / "summary.csv").set_index("controller")
    assert f"naive earns a reward of {summary.loc['naive', 'reward']:.2f} per step" in said
    for name in CONTROLLERS:
        row = page.texts.index(name, page.texts.index("controller"))
        assert page.texts[row + 1] == f"{summary.loc[name, 'reward']:.2f}"
    figures = [image["alt"].split(".")[0] for image in page.all("img")]
    assert figures == [f"Stay Back, {name}" for name in ("bars", "timeline", "decisions")]
    for image in page.all("img"):
        assert imageio.imread(content(image["src"], "image/png")).std() > 10
    (film,) = page.all("video")
    assert "naive above, switching:0.4 below" in film["aria-label"]
    frames = imageio.imread(content(film["src"], "video/mp4"), plugin="pyav", extension=".mp4")
    assert frames.shape == (35, 816, 960, 3)
    assert f"ms-highway compare stay_back --controllers naive switching:0.4 --out {compared} --seeds 1" in said
    assert f"jax {version('jax')}" in said
    assert {"human reward", "learned"} <= set(page.texts)
    assert "are missing" not in said


def test_what_is_filmed_for_the_page_is_the_episode_that_was_recorded(compared):
    results = read_results(compared)
    filmed = film("stay_back", "switching:0.4", 1, **results.config("stay_back")).records
    recorded = results.records.query("controller == 'switching:0.4' and seed == 1")
    np.testing.assert_allclose([record["reward"] for record in filmed], recorded["reward"])
    assert [record["model"] for record in filmed] == list(recorded["model"])


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
    page = Page(out.read_text())
    assert "3 of the requested episodes are missing." in page.texts
    assert "<script>alert(1)</script>" in page.texts
    assert not page.all("script") + page.all("video")
    assert [path.name for path in out.parent.iterdir()] == [out.name]


def test_a_page_has_all_controllers_in_its_table_and_a_curve_of_three_lambdas(compared, tmp_path):
    records = pd.read_csv(compared / "steps.csv")
    naive, switching = (records[records["controller"] == name] for name in CONTROLLERS)
    more = [naive.assign(controller=f"schedule:turn={steps},naive") for steps in range(1, 8)]
    more += [switching.assign(controller=f"switching:{price}") for price in (0.1, 5)]
    directory = with_settings(compared, tmp_path / "more")
    pd.concat([records, *more]).to_csv(directory / "steps.csv", index=False)
    run(f"report {directory} --no-videos")
    page = Page((directory / "report.html").read_text())
    assert {"naive", "switching:0.4", "switching:5", "schedule:turn=3,naive"} <= set(page.texts)
    figures = [image["alt"].split(".")[0] for image in page.all("img")]
    assert figures == [f"Stay Back, {name}" for name in ("curve", "timeline", "decisions")]


def test_what_the_paper_published_stands_beside_what_may_be_compared_with_it_only(compared):
    results = read_results(compared)
    released = results.settings | {"semantics": "released", "human_reward": "published"}
    assert results_table(replace(results, settings=released), "stay_back")["published"].tolist() == ["-7.73", "2.59"]
    for change in ({"semantics": "paper"}, {"human_reward": "learned"}, {"costs": "measured"}, {"horizon": 5}):
        assert "published" not in results_table(replace(results, settings=released | change), "stay_back")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("", "the following arguments are required: DIR; see the --help of the command"),
        ("elsewhere", "there is no directory elsewhere; name a directory that `ms-highway compare` wrote"),
        (".", "has no settings.json; name a directory that `ms-highway compare` wrote"),
        ("{} --out page.pdf", "'page.pdf' is no name that ends in .html"),
    ],
)
def test_a_page_that_cannot_be_is_refused_in_one_line(words, message, compared, refused):
    assert message in refused(f"report {words.format(compared, compared)}".strip())
