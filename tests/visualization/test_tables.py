"""Tables and figures of what was learned."""

from ms_highway.data.learned_reward import shipped
from ms_highway.irl.evaluation import LEVELS, Evaluation
from ms_highway.irl.prediction import PREDICTORS
from ms_highway.visualization.irl import evaluation_tables, learned_tables

KINDS = (
    "fde",
    "ade",
    "rmse",
    "miss",
    "log_p",
    *(f"inside {level}" for level in LEVELS),
)


def test_tables_show_what_was_found():
    predictors = {
        name: {kind: {"3": 0.15, "5": 0.25} for kind in KINDS} for name in PREDICTORS
    }
    braking = {
        "windows": {"3": 4.0, "5": 0.0},
        **{name: {"3": 0.15} for name in PREDICTORS},
    }
    regimes = {kind: {"braking": braking} for kind in ("distance", "log_p")}
    evaluation = Evaluation(predictors, regimes, windows=12, tracks=3)
    metrics, regimes, *_ = evaluation_tables(evaluation)
    assert metrics.attrs["title"] == "12 predictions of 3 drivers"
    # FDE, RMSE and log p have two decimals.
    assert (metrics == "0.25").to_numpy().sum() == 3 * len(PREDICTORS)
    assert "25.0%" in metrics.to_numpy()
    assert (regimes == "0.15").to_numpy().sum() == len(PREDICTORS)

    weights, drivers = learned_tables(shipped("us101"), {"headway": 0.5})
    assert weights.attrs["title"] == "learned from 6856 segments"
    assert weights["true"].loc["headway"] == "0.5"
    assert {"patiences", "headway while changing lanes"} <= set(drivers.index)
