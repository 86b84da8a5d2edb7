"""The page that is made of a comparison."""

import json
import shutil
import subprocess
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

PROBE = """<script>
addEventListener("load", () => {
  const films = [...document.querySelectorAll("video")];
  const tell = () => document.title = "seen " + JSON.stringify({
    images: [...document.images].map(image => image.naturalWidth),
    films: films.map(film => [film.videoWidth, film.duration]),
    below: films.every(film => film.clientHeight - film.clientWidth * film.videoHeight / film.videoWidth > 60),
    fits: document.documentElement.scrollWidth <= innerWidth,
    loaded: performance.getEntriesByType("resource").map(entry => entry.name.slice(0, 40)),
  });
  tell();
  films.forEach(film => film.addEventListener("loadeddata", tell));
})
</script></body>"""


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


def test_a_browser_shows_every_picture_and_the_video_above_its_controls_without_loading_anything(html, tmp_path):
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if not browser:
        pytest.skip("neither chromium nor google-chrome is installed")
    page = tmp_path / "page.html"
    page.write_text(html.replace("</body>", PROBE))
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}"]
    shown = subprocess.run(
        [browser, *options, "--window-size=600,900", "--timeout=5000", "--dump-dom", page.as_uri()],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    seen = json.loads(shown.stdout.partition("<title>seen ")[2].partition("</title>")[0])
    assert seen == {"images": [1600] * 3, "films": [[960, 3.5]], "below": True, "fits": True, "loaded": []}
    assert "CONSOLE" not in shown.stderr


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
        ("", "the following arguments are required: DIR; see ms-highway report --help"),
        ("elsewhere", "there is no directory elsewhere; name a directory that `ms-highway compare` wrote"),
        (".", "has no settings.json; name a directory that `ms-highway compare` wrote"),
        ("{} --out page.pdf", "--out is page.pdf; name an .html file"),
    ],
)
def test_a_page_that_cannot_be_is_refused_in_one_line(words, message, compared, refused):
    assert message in refused(f"report {words.format(compared, compared)}".strip())


def test_a_page_that_cannot_be_written_is_refused_before_anything_is_drawn(compared, tmp_path, refused):
    for name in ("steps.csv", "settings.json"):
        shutil.copy(compared / name, tmp_path)
    (tmp_path / "report.html").mkdir()
    assert "report.html cannot be written: it is a directory" in refused("report .")
