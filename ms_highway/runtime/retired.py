"""Say what to use instead of names that version 2.0.0 retired."""

from collections.abc import Mapping

ON_PAGE = "its figures are on the results page"
SAME_STARTS = f"compare drivers from the same --seed and --seeds; {ON_PAGE}"
EXPORT = "give --export DIR, and let CommonRoad's own tools plan in the files or judge them"
PEERS = f"compare with idm or an agent of stable-baselines3; {ON_PAGE}"
ROADS = f"on stock roads use idm or tom; {ON_PAGE}"
NULL = f"leave it out, as it earned nothing measurable; {ON_PAGE}"
NEAREST = "use nearest:K, which no other ranking beat"
CLUSTER = "run a cluster of dask.distributed and give its --scheduler"
MAXENT = f"use --driver maxent; {ON_PAGE}"
FITTED = f"use fitted_idm or model; {ON_PAGE}"

OPTIONS = {
    "bench --peer": "the comparison with CasADi is on the results page",
    "bench --crowd": "give --set humans=N",
    "bench --seed": "it is called --first-seed, as in compare",
    "bench road --figure": "plot the file of --json or --log",
    "bench road --jobs": "leave it out: there is a process for each core",
    "bench road --bound": SAME_STARTS,
    "bench road --traffic unyielding": "use --traffic aggressive",
    "bench road --judge": EXPORT,
    "sweep --coordinator": CLUSTER,
    "sweep --processes": CLUSTER,
    "sweep --process": CLUSTER,
    "report --markdown": "compare prints the table and writes summary.csv",
    "report --values": "compare draws what learned values estimate, in SCENARIO_decisions.png",
    "report --drivers": "irl evaluate prints the tables of predictions, and its --figures DIR draws them",
    "values learn --generated": "name the scenarios to learn in, your own too with --import",
    "values learn --solvers": "learn a file for each solver, with --set solver=NAME",
    "values learn --without": "what inputs of learned values are worth is on the results page",
    "irl evaluate --learn": "give it to irl fit, which says how likely held-out segments are",
    "irl evaluate --horizon": "give it to irl fit, which says how likely held-out segments are",
    "irl evaluate --others": f"leave it out, as predictions know nothing of the future; {ON_PAGE}",
    "irl record --driver optimal": MAXENT,
    "irl record --driver mpc": MAXENT,
}
"""Options by command, some with a value."""

CONTROLLERS = dict.fromkeys(("ttc", "influence", "barrier", "risk"), NEAREST)
DRIVERS = {
    "search": SAME_STARTS,
    "reactive": EXPORT,
    "reactive-default": EXPORT,
    "idle": PEERS,
    "random": PEERS,
    "turn": ROADS,
    "fixed:turn": ROADS,
    "traits": NULL,
    "belief": NULL,
    "measured": "say 'shipped', or give milliseconds by model",
}
"""Drivers of roads, keys of their configuration, and a model."""

PREDICTORS = dict.fromkeys(("turn_and_accelerate", "lane_modes"), FITTED)
NAMES = {"RoadPolicy": "use ms_highway.drive(env, config), and step it with any action"}


def replacement(retired: Mapping[str, str], *names: str) -> str:
    """Return a sentence that says what to use instead of the first of these names that is retired, or nothing."""
    return next((f"{name} is gone since 2.0.0: {retired[name]}" for name in names if name in retired), "")
