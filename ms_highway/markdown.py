"""A comparison as a table in Markdown, of one directory of results or of several beside each other."""

from collections.abc import Sequence

from ms_highway.report import cells
from ms_highway.results import Results

__all__ = ["markdown_table"]

OUTCOME = "reward/step", "90 % interval", "collisions"
DISTINGUISHING = ("semantics", "human_reward", "solver", "costs")


def markdown_table(results: Sequence[Results]) -> str:
    """A row per scenario and controller of the first results.

    Columns: of every directory the reward per step with its interval and the episodes with a collision, headed by what
    distinguishes it from the others; of the first also times and shares of models; the paper's reward where it
    published one. A cell is empty where a directory has no such episodes.

    Raises:
        ValueError: if two of the directories are the same.
    """
    if len({result.directory.resolve() for result in results}) < len(results):
        raise ValueError("a directory is named twice; name each once")
    found = [_by_controller(result) for result in results]
    headings = ["scenario", "controller"]
    for name in _names(results):
        headings += [f"reward per step (90 % interval){name}", f"episodes with a collision{name}"]
    rest = [name for name in next(iter(found[0].values())) if name not in (*OUTCOME, "controller", "counted ms")]
    lines = [[*headings, *rest, "published"], ["---"] * (len(headings) + len(rest) + 1)]
    for key, row in found[0].items():
        outcomes = [text for rows in found for text in _outcome(rows.get(key))]
        published = results[0].published(*key)
        lines.append([*key, *outcomes, *(row[name] for name in rest), f"{published.reward:.2f}" if published else ""])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _by_controller(result: Results) -> dict[tuple[str, str], dict[str, str]]:
    """The texts of a comparison's cells by scenario and controller."""
    return {
        (scenario, row["controller"]): row
        for scenario in result.scenarios
        for row in cells(result.summaries, scenario).to_dict("records")
    }


def _outcome(row: dict[str, str] | None) -> list[str]:
    if row is None:
        return ["", ""]
    reward, interval, collisions = (row[name] for name in OUTCOME)
    return [f"{reward} ({interval})", collisions]


def _names(results: Sequence[Results]) -> list[str]:
    """What to call each: the first settings that tell all apart, else the directories; nothing where there is one."""
    if len(results) == 1:
        return [""]
    told: list[list[str]] = [[] for _ in results]
    for key in DISTINGUISHING:
        values = [result.settings.get(key) for result in results]
        if any(value != values[0] for value in values):
            for name, value in zip(told, values, strict=True):
                name.append(f"{value if isinstance(value, str) else 'given'} {key.replace('_', ' ')}")
        if len({tuple(name) for name in told}) == len(results):
            return [", " + ", ".join(name) for name in told]
    return [f", {result.directory}" for result in results]
