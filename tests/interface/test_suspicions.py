"""No number is wrong without a word: fans are matched by name, and units that cannot be right are refused or said."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import fantwin

FANS = {"CPU": (2200.0, 1.5), "front": (1600.0, 2.5), "rear": (1400.0, 2.0)}
"""speed in rpm at full command, and seconds to settle"""
NOISE_RPM = 15.0
COLUMNS = fantwin.Columns(time="t", fan="fan", command="pwm", speed="rpm:rpm")


def table_of(seed: int, seconds: int = 400) -> pd.DataFrame:
    """Three fans of a PC, sampled each second, with commands from 60 to 255, a row for each sample of a fan."""
    rng, parts = np.random.default_rng(seed), []
    for name, (top_rpm, inertia_s) in FANS.items():
        pwm = np.repeat(rng.uniform(60.0, 255.0, seconds // 20 + 1), 20)[:seconds].round()
        speed = np.full(seconds, pwm[0] / 255.0)
        for now in range(1, seconds):
            speed[now] = speed[now - 1]
            for _ in range(20):
                drag = 0.3 * speed[now] + 0.7 * speed[now] ** 2
                speed[now] += 0.05 * (pwm[now - 1] / 255.0 - drag) / inertia_s
        rpm = speed * top_rpm + rng.normal(0.0, NOISE_RPM, seconds)
        parts.append(pd.DataFrame({"t": np.arange(float(seconds)), "fan": name, "pwm": pwm, "rpm": rpm}))
    return pd.concat(parts).sort_values(["t", "fan"], kind="stable", ignore_index=True)


@pytest.fixture(scope="module")
def table() -> pd.DataFrame:
    return table_of(3, 120)


@pytest.fixture(scope="module")
def twin() -> fantwin.Twin:
    """Its held-out table has the fans in another order."""
    other = table_of(2, 200).sort_values(["fan", "t"], ascending=[False, True])
    return quiet(partial(fantwin.train, table_of(1), COLUMNS, validate=other, name="pc", model="physical"))[0]


def quiet(work: Callable[[], Any]) -> tuple[Any, list[str]]:
    """What comes out, and what is said meanwhile."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        return work(), [str(each.message) for each in said if each.category is fantwin.FantwinWarning]


def by_name(fans: dict[str, str]) -> fantwin.Columns:
    """Columns of a wide table. fans: names of the fans and of their columns."""
    return fantwin.Columns(
        time="t",
        command={name: f"pwm_{column}" for name, column in fans.items()},
        speed={name: f"rpm_{column}:rpm" for name, column in fans.items()},
    )


def wide(table: pd.DataFrame) -> pd.DataFrame:
    found = table.pivot(index="t", columns="fan", values=["pwm", "rpm"])
    return found.set_axis(["_".join(names) for names in found.columns], axis=1).reset_index()


ORDERS: dict[str, Callable[[pd.DataFrame], tuple[Any, fantwin.Columns]]] = {
    "as trained": lambda table: (table, COLUMNS),
    "backwards at each time": lambda table: (table.sort_values(["t", "fan"], ascending=[True, False]), COLUMNS),
    "fan after fan": lambda table: (table.sort_values(["fan", "t"], ascending=[False, True]), COLUMNS),
    "columns": lambda table: (wide(table), by_name({name: name for name in ("rear", "CPU", "front")})),
    "pattern": lambda table: (
        wide(table)[["t", *(f"{what}_{fan}" for fan in ("rear", "front", "CPU") for what in ("rpm", "pwm"))]],
        fantwin.Columns(time="t", command="pwm_*", speed="rpm_*:rpm"),
    ),
}


@pytest.mark.parametrize("order", ORDERS)
def test_fans_are_matched_by_name_in_any_order_of_rows_and_columns(twin, table, order):
    answer, said = quiet(lambda: twin.predict(*ORDERS[order](table)))
    own = answer[answer["valid"]].groupby("fan")["residual_rpm"].std()
    assert not said and set(own.index) == set(FANS) and own.max() < 1.6 * NOISE_RPM
    assert twin.card.validation.rmse is not None and twin.card.validation.rmse < 1.6 * NOISE_RPM * np.pi / 30
    assert twin.card.training.fan_names == tuple(FANS) and "3 fans (CPU, front, rear)" in str(twin.card)


def test_fans_that_cannot_be_matched_by_name_are_refused_or_matched_by_order_with_a_word(twin, table):
    lists = "has the fans X, front, rear, and the twin has CPU, front, rear: call them alike"
    with pytest.raises(fantwin.FantwinError, match=lists):
        twin.predict(table.replace({"fan": {"CPU": "X"}}), COLUMNS)
    commands, said = quiet(lambda: twin.predict({"time": [0.0, 1.0], "command": [99, 99]}, initial_speed_rpm=900.0))
    assert list(commands["fan"]) == [*FANS, *FANS] and not said
    numbered = table.assign(fan=table["fan"].map({"CPU": 1, "front": 2, "rear": 3}))
    answer, said = quiet(lambda: twin.predict(numbered, COLUMNS))
    assert ["1, 2, 3, and the twin has CPU, front, rear: they are matched in this order" in each for each in said] == [
        1
    ]
    assert answer.loc[answer["valid"], "residual_rpm"].std() < 1.6 * NOISE_RPM
    columns = wide(numbered.assign(fan=numbered["fan"].astype(str)))
    backwards = columns[["t", *sorted(columns.columns.drop("t"), reverse=True)]]
    answers = quiet(lambda: twin.predict(backwards, fantwin.Columns(time="t", command="pwm_*", speed="rpm_*:rpm")))[0]
    pd.testing.assert_frame_equal(answers, answer)


SUSPECT: dict[str, tuple[Callable[[pd.DataFrame], tuple[Any, fantwin.Columns]], str, bool]] = {
    "rad/s as rpm": (
        lambda table: (table.assign(rpm=table["rpm"] * np.pi / 30), COLUMNS),
        "has speeds in rad/s, not in rpm",
        True,
    ),
    "hz as rpm": (lambda table: (table.assign(rpm=table["rpm"] / 60), COLUMNS), "has speeds in hz, not in rpm", True),
    "below zero": (lambda table: (table.assign(rpm=-table["rpm"]), COLUMNS), "has speeds below zero", True),
    "swapped": (
        lambda table: (table.rename(columns={"pwm": "rpm", "rpm": "pwm"}), COLUMNS),
        "are the two columns swapped?",
        True,
    ),
    "percent": (
        lambda table: (table.assign(pwm=table["pwm"] / 2.55), COLUMNS),
        "times what the twin predicts by the commands",
        False,
    ),
    "half the pulses": (
        lambda table: (table.assign(rpm=table["rpm"] / 2), COLUMNS),
        "the speeds are 0.5 times what the twin predicts",
        False,
    ),
    "every 10 s": (
        lambda table: (table[table["t"] % 10 == 0], COLUMNS),
        "a sample every 10 s, and its fans settle",
        False,
    ),
    "minutes": (lambda table: (table.assign(t=table["t"] / 60), COLUMNS), "of 120 times 3 remain", False),
    "no time": (
        lambda table: (table.assign(t=pd.to_datetime(table["t"].mask(table.index == 31), unit="s")), COLUMNS),
        "1 rows dropped: their time cannot be read",
        False,
    ),
    "no fan column": (
        lambda table: (table.drop(columns="fan"), fantwin.Columns(time="t", command="pwm", speed="rpm:rpm")),
        "has 1 fan(s), and the twin is of 3",
        True,
    ),
}


@pytest.mark.parametrize("case", SUSPECT)
def test_units_that_cannot_be_right_are_refused_or_said_and_no_unknown_number_is_valid(twin, table, case):
    change, words, is_refused = SUSPECT[case]
    if is_refused:
        with pytest.raises(fantwin.FantwinError, match=re.escape(words)):
            quiet(lambda: twin.predict(*change(table)))
        return
    answer, said = quiet(lambda: twin.predict(*change(table)))
    assert sum(words in line for line in said) == 1
    unknown = answer[["speed_rpm", "predicted_rpm", "residual_rpm"]].isna().any(axis=1)
    assert not (unknown & answer["valid"]).any() and ((answer["reason"] == "") == answer["valid"]).all()


def test_a_speed_that_was_not_measured_stays_unknown_and_says_so(twin, table):
    is_missing = (table["t"] % 7 == 0) & (table["fan"] == "front")
    holes = table.assign(rpm=table["rpm"].mask(is_missing))
    prediction, scores = quiet(lambda: twin.predict(holes, COLUMNS))[0], quiet(lambda: twin.score(holes, COLUMNS))[0]
    for answer in (prediction, scores):
        rows = answer.merge(holes, left_on=["time", "fan"], right_on=["t", "fan"])
        own = rows[rows["rpm"].isna() & (rows["t"] > 0)]
        assert len(own) > 10 and own["speed_rpm"].isna().all() and own["residual_rpm"].isna().all()
        assert not own["valid"].any() and set(own["reason"]) == {"no_speed"} and own["predicted_rpm"].notna().all()
        assert np.allclose(rows["speed_rpm"].dropna(), rows["rpm"].dropna())
    assert (prediction["valid"] == scores["valid"]).all() and "deviation_rpm" not in prediction
    pd.testing.assert_frame_equal(prediction, scores[prediction.columns], rtol=1e-6)


def test_durations_are_times_and_alarms_take_no_second_scoring(twin, table, monkeypatch):
    durations = table.assign(t=pd.to_timedelta(table["t"], unit="s"))
    scores = quiet(lambda: twin.score(durations, COLUMNS))[0]
    assert scores["time"].dtype == "timedelta64[ns]" and scores["time"].iloc[-1] == pd.Timedelta("119s")
    monkeypatch.setattr("fantwin.interface.decisions.rescore", None)
    alarms = quiet(lambda: twin.alarms(durations, COLUMNS))[0]
    assert alarms.dtypes.astype(str).to_dict() == {
        "fan": scores["fan"].dtype,
        **dict.fromkeys(("raised", "cleared", "onset"), "timedelta64[ns]"),
        **dict.fromkeys(("severity", "cause"), scores["cause"].dtype),
        "probability": "float64",
        "causes": alarms["causes"].dtype,
    }
    monkeypatch.undo()
    changed = durations.assign(rpm=durations["rpm"] * 1.01)
    assert not quiet(lambda: twin.score(changed, COLUMNS))[0]["score"].equals(scores["score"])


def test_causes_of_alarms_survive_a_file(twin, table, tmp_path: Path):
    slow = table_of(3, 400)
    slow = slow.assign(rpm=slow["rpm"].where((slow["fan"] != "rear") | (slow["t"] < 200), slow["rpm"] * 0.7))
    alarms = quiet(lambda: twin.alarms(slow, COLUMNS))[0]
    assert list(alarms["fan"]) == ["rear"] and alarms["causes"][0][0]["cause"] == alarms["cause"][0]
    alarms.to_parquet(tmp_path / "alarms.parquet")
    read = pd.read_parquet(tmp_path / "alarms.parquet")
    assert list(read["causes"][0]) == alarms["causes"][0]


def test_too_short_tables_are_refused_before_the_work_and_a_target_is_called_one(twin, table, monkeypatch):
    monkeypatch.setattr("fantwin.interface.making.calibrated_on", None)
    with pytest.raises(fantwin.FantwinError, match="0.099 fan-hours of healthy running cannot show 1 false alarm"):
        fantwin.calibrate(twin, table, COLUMNS, false_alarms_per_day=1)
    monkeypatch.undo()
    slow = table.assign(rpm=table["rpm"].where(table["fan"] != "rear", table["rpm"] * 0.9))
    both = partial(fantwin.calibrate, twin, [table, slow], COLUMNS, false_alarms_per_day=8, extrapolate=True)
    target, said = quiet(both)
    assert any(line.startswith("table 2: table rear is 10 % slower than its twin") for line in said), said
    assert repr(target).endswith("1 Hz, calibrated, its rate of false alarms is only a target)")


def test_errors_of_a_training_name_the_fans_of_the_table(table):
    (_, said) = quiet(
        lambda: fantwin.train(table.assign(rpm=(table["rpm"] / 30).round() * 30), COLUMNS, model="physical")
    )
    assert any(line.startswith("CPU") and 'tacho="count:pulses=2,window_s=1.0"' in line for line in said)
    assert not [line for line in said if "/tmp" in line or "[[" in line or "--" in line]
    with pytest.raises(fantwin.FantwinError, match="^CPU: the command never changes"):
        quiet(lambda: fantwin.train(table.assign(pwm=100.0), COLUMNS))
