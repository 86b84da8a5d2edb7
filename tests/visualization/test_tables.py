"""Tables and figures of what was learned."""

from ms_highway.game.learned_reward import shipped
from ms_highway.irl.evaluation import LEVELS, Evaluation
from ms_highway.irl.prediction import PREDICTORS
from ms_highway.visualization.irl import evaluation_tables, learned_tables

KINDS = ("fde", "ade", "rmse", "miss", "log_p", *(f"inside {level}" for level in LEVELS))


def evaluation():
    errors = {str(horizon): 0.5 * horizon for horizon in (1, 2, 3, 5)}
    rows = {name: {kind: dict(errors) for kind in KINDS} for name in PREDICTORS}
    for place, row in enumerate(rows.values()):
        row["miss"] = dict.fromkeys(errors, 0.1 * (place + 1))
        row["inside 90"] = dict.fromkeys(errors, 0.9 - 0.01 * place)
    windows = {"1": 4.0, "2": 4.0, "3": 4.0, "5": 0.0}
    braking = {"windows": windows, **{name: {"1": 0.5, "2": 1.0, "3": 1.5} for name in PREDICTORS}}
    return Evaluation(rows, {"distance": {"braking": braking}, "log_p": {"braking": braking}}, 12, 3)


def test_tables_show_what_was_found():
    metrics, regimes, *_ = evaluation_tables(evaluation())
    assert metrics.attrs["title"] == "12 predictions of 3 drivers"
    assert (metrics == "2.50").to_numpy().sum() == 3 * len(PREDICTORS)  # FDE, RMSE and log p
    assert "90.0%" in metrics.to_numpy()
    assert (regimes == "1.50").to_numpy().sum() == len(PREDICTORS)
    weights, drivers = learned_tables(shipped("us101"), {"headway": 0.5})
    assert weights.attrs["title"] == "learned from 6856 segments"
    assert weights["true"].loc["headway"] == "0.5"
    assert {"patiences", "headway while changing lanes"} <= set(drivers.index)
