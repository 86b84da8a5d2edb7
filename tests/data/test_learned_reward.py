"""Learned rewards as files."""

import json

import numpy as np
import pytest
from msgspec import structs

from ms_highway.data.learned_reward import SHIPPED, load, save, shipped
from ms_highway.game.scenario import COMMON_WEIGHTS


@pytest.mark.parametrize("name", SHIPPED)
def test_a_learned_reward_is_read_as_it_was_written(name, tmp_path):
    save(shipped(name), tmp_path / "theta.json")
    assert load(tmp_path / "theta.json") == shipped(name)


def test_the_shipped_rewards_have_converged():
    simulated, real = (shipped(name) for name in SHIPPED)
    for learned in (simulated, real):
        assert learned.converged
        lost = learned.log_likelihood["train"] - learned.log_likelihood["held_out"]
        assert 0 <= lost < 0.5
    for name in simulated.learned:
        assert 1 / 1.05 < simulated.weights[name] / COMMON_WEIGHTS[name] < 1.05
    assert set(real.learned) > {"headway", "closing_speed", "comfort_steering"}


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda content: content.update(version=2), "of version 2, not 3"),
        (
            lambda content: content["weights"].update(speed=float("nan")),
            "the weight of speed is nan",
        ),
        (
            lambda content: content["drivers"]["weights"].pop("headway"),
            "weights of drivers lack .* headway",
        ),
        (
            lambda content: content["drivers"]["peers"]["idm"]["spread"][
                "along"
            ].__setitem__(1, "far"),
            (
                r"\(drivers\.peers\.idm\.spread\.along\[1\] is 'far': Expected `float`,"
                r" got `str`\)"
            ),
        ),
        (
            lambda content: content["feature_counts"]["human"].pop("speed"),
            "feature_counts.human lacks .* speed",
        ),
    ],
)
def test_a_damaged_or_old_file_is_refused_with_a_remedy(damage, message, tmp_path):
    path = tmp_path / "theta.json"
    save(shipped("us101"), path)
    content = json.loads(path.read_text())
    damage(content)
    path.write_text(json.dumps(content))
    with pytest.raises(
        ValueError, match=rf"theta\.json .*{message}.*ms-highway irl fit"
    ):
        load(path)


DAMAGES = None, "x", float("nan"), -(10.0**39), [], {"other": 1}, [[]]


def places(content, *keys):
    """All places in JSON content, of lists only the first."""
    yield keys
    parts = (
        content.items()
        if isinstance(content, dict)
        else enumerate(content[:1])
        if isinstance(content, list)
        else ()
    )
    for key, part in parts:
        yield from places(part, *keys, key)


def test_a_short_sentence_names_any_damage(
    tmp_path,
):
    """A tenth of all damages; texts for which any content is right, such as provenance,
    cannot be damaged.
    """
    path = tmp_path / "theta.json"
    save(shipped("us101"), path)
    text = path.read_text()
    free = "provenance", "learned_from"
    damages = [
        (keys, damage)
        for keys in places(json.loads(text))
        if keys and keys[0] not in free
        for damage in DAMAGES
        if damage is not None
        or keys[-1] not in ("drivers", "tails", "train", "held_out")
    ]
    for keys, damage in damages[::10]:
        whole = place = json.loads(text)
        for key in keys[:-1]:
            place = place[key]
        place[keys[-1]] = damage
        path.write_text(json.dumps(whole))
        with pytest.raises(
            ValueError, match=r"theta\.json cannot be read as a learned reward"
        ) as refusal:
            load(path)
        (line,) = str(refusal.value).splitlines()
        assert len(line) < 400
        names = [key for key in keys if isinstance(key, str)]
        assert names[-1] in line or names[0] in line, f"{names} in {line}"


def test_unknown_rewards_are_refused():
    with pytest.raises(
        ValueError, match="no learned reward 'us102' comes with ms_highway"
    ):
        shipped("us102")


def test_an_interval_is_as_wide_as_its_covariance_says():
    learned = shipped("demonstrations")
    wide = structs.replace(
        learned, covariance=(4 * np.array(learned.covariance)).tolist()
    )
    narrow_width, wide_width = (
        np.ptp(np.log(each.interval("speed"))) for each in (learned, wide)
    )
    assert wide_width == pytest.approx(2 * narrow_width)
