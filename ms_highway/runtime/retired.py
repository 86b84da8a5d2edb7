"""Say what to use instead of the names that version 2.0.0 retired."""

ON_PAGE = "its figures are on the results page"
RANKING = "use nearest:K, which no other ranking beat"
PROCESSES = "run a cluster of dask.distributed and give its --scheduler"
MEASURES = f"leave it out: it earned nothing measurable, and {ON_PAGE}"
MAXENT = f"use the driver maxent; {ON_PAGE}"
PREDICTOR = f"use fitted_idm or model; {ON_PAGE}"

RETIRED = {
    "bench --peer": "the comparison with CasADi is on the results page",
    "bench road --bound": f"compare drivers from the same --seed and --seeds; {ON_PAGE}",
    "bench road --judge": "give --export DIR, and let commonroad-drivability-checker judge the files",
    "search": ON_PAGE,
    "reactive": ON_PAGE,
    "reactive-default": ON_PAGE,
    "ttc": RANKING,
    "influence": RANKING,
    "barrier": RANKING,
    "risk": RANKING,
    "fixed:turn": f"use fixed:idm or fixed:tom; {ON_PAGE}",
    "traits": MEASURES,
    "belief": f"{MEASURES}; controllers of the package's own scenarios keep +belief",
    "RoadPolicy": "use ms_highway.drive(env, config), and step it with any action",
    "sweep --coordinator": PROCESSES,
    "sweep --processes": PROCESSES,
    "sweep --process": PROCESSES,
    "report --markdown": "compare prints the table and writes summary.csv",
    "report --values": "compare draws what learned values estimate, in SCENARIO_decisions.png",
    "report --drivers": "irl evaluate prints the tables of predictions, and its --figures DIR draws them",
    "values learn --generated": "name the scenarios to learn in, your own too with --import",
    "values learn --without": "what inputs of learned values are worth is on the results page",
    "irl record optimal": MAXENT,
    "irl record mpc": MAXENT,
    "turn_and_accelerate": PREDICTOR,
    "lane_modes": PREDICTOR,
}
"""What to use instead, by controller, driver, key and public name; of options, the command comes first."""


def replacement(*names: str) -> str:
    """Return a sentence that says what to use instead of the first of these names that is retired, or nothing."""
    return next((f"{name} is gone since 2.0.0: {RETIRED[name]}" for name in names if name in RETIRED), "")
