"""Make a page of a comparison, in one file that needs no other; and LaTeX tables."""

import base64

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined

from ms_highway.envs.colors import model_meaning
from ms_highway.experiments.comparison import common_seeds, models_of
from ms_highway.experiments.summary import Results, answer, most_informative_pair
from ms_highway.game.scenario import title
from ms_highway.runtime.process import Progress, silent
from ms_highway.visualization import video
from ms_highway.visualization.figures import CAPTIONS, figures
from ms_highway.visualization.style import drawn
from ms_highway.visualization.tables import cells, latex
from ms_highway.visualization.tradeoff import episode_count


def page(
    results: Results,
    videos: bool = True,
    progress: Progress = silent,
    own: bool = False,
) -> str:
    """Return the page of a comparison, as HTML.

    It has a section for each scenario, and the settings of the results.

    Args:
        results: of the comparison.
        videos: whether films are made.
        progress: called with a message before each scenario.
        own: whether films show controllers that run code from elsewhere, such as files
            of agents.

    Raises:
        ImportError: for videos without the packages of the extra ``video``.
        ValueError: if episodes cannot be run again under the settings of the results.
    """
    sections = []
    summaries = results.summaries
    for scenario in results.scenarios:
        progress(f"drawing {scenario}{' and filming it' if videos else ''}")
        pictures = {}
        for name, content in drawn(
            figures(results.records, summaries, scenario)
        ).items():
            pictures[name] = (_data("image/png", content), CAPTIONS[name])
        section = {
            "title": title(scenario),
            "answer": answer(results.records, summaries, scenario),
            "table": results_table(results, scenario).to_dict("split"),
            "figures": pictures,
            "film": _film(results, scenario, own) if videos else None,
        }
        sections.append(section)

    # Models in use, and settings that say how the results were made.
    models = {}
    for name in models_of(summaries, "share"):
        if summaries[f"share_{name}"].any():
            models[name] = model_meaning(name) or "a model that was added"
    settings = {
        name: value
        for name, value in results.settings.items()
        if name not in ("asked", "lengths") and value != {}
    }

    environment = Environment(
        loader=PackageLoader("ms_highway", "data"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    environment.filters["text"] = _text
    return environment.get_template("report.html.jinja").render(
        sections=sections,
        models=models,
        settings=settings,
        runs=results.runs,
        missing=results.missing,
    )


def results_table(results: Results, scenario: str) -> pd.DataFrame:
    """Return the texts of `cells`.

    They have columns for the paper's figures if these may be compared.
    """
    texts = cells(results.summaries, scenario)
    rewards = []
    milliseconds = []
    for controller in texts["controller"]:
        published = results.published(scenario, controller)
        reward, seconds = published or (None, None)
        rewards.append("" if reward is None else f"{reward:.2f}")
        milliseconds.append("" if seconds is None else f"{1e3 * seconds:.0f}")
    if any(rewards):
        texts["published"] = rewards
        texts["published ms"] = milliseconds
    return texts


def latex_tables(results: Results) -> str:
    """Return the table of each scenario as LaTeX, with the label ``tab:SCENARIO``."""
    tables = [r"% needs \usepackage{booktabs}"]
    for scenario in results.scenarios:
        rows = results.summaries.query("scenario == @scenario")
        caption = (
            f"{title(scenario)}: means per step, with 90 % intervals over episodes;"
            f" {episode_count(rows)}."
        )
        texts = results_table(results, scenario)
        tables.append(latex(texts, caption, f"tab:{scenario}"))
    return "\n".join(tables)


def _film(results: Results, scenario: str, own: bool) -> dict | None:
    """Film the most informative controllers from the first start that they share.

    Sizes are in px. The result is None if no controller may be filmed.
    """
    controllers = most_informative_pair(results.summaries, scenario, own)
    if not controllers:
        return None
    results.refuse_changed(scenario, controllers)
    seed = next(iter(common_seeds(results.records, scenario, controllers)), 0)
    films = video.film_together(scenario, controllers, seed, **results.config(scenario))
    pictures = video.side_by_side(films)
    height, width, _ = pictures[0].shape
    places = controllers[0]
    if len(controllers) > 1:
        places = " above, ".join(controllers) + " below"
    content = video.encoded(pictures, ".mp4", films[0].frames_per_second)
    return {
        "source": _data("video/mp4", content),
        "width": width,
        "height": height,
        "caption": (
            f"Episode {seed}, at true speed: {places}. Times are as measured while"
            " filming; other episodes differ."
        ),
    }


def _data(kind: str, file: bytes) -> str:
    """Return the content of a file as the source of an element of a page."""
    return f"data:{kind};base64,{base64.b64encode(file).decode()}"


def _text(value: object) -> str:
    """Return a value as text, a mapping part by part."""
    if isinstance(value, dict):
        return ", ".join(f"{name} {_text(part)}" for name, part in value.items())
    return f"{value:.4g}" if isinstance(value, float) else str(value)
