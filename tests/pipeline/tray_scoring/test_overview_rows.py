"""The overview of a tray says of each second what its samples did, however the scores are cut into messages."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from fantwin.pipeline.tray_scoring.overview_rows import MESSAGE_NS, OverviewRows
from fantwin.schemas.blocks import cut, join
from fantwin.schemas.fields import columns
from fantwin.schemas.messages import Array, Overview, Score
from tests.support.made_messages import filled

FANS = 3
START_NS = 1_790_000_000_300_000_000
VALUES = tuple(name for name in columns(Overview) if name != "t_ns")


def scores(rate_hz: float, seconds: float) -> Score:
    """Fan 0 is always judged, of fan 1 and 2 half of the samples; some readings are missing, and some samples."""
    rng = np.random.default_rng(3)
    period_ns = round(1e9 / rate_hz)
    number = np.flatnonzero(rng.random(round(seconds * rate_hz)) > 0.05)
    number = number[(number < 0.4 * number[-1]) | (number > 0.6 * number[-1])]
    shape = len(number), FANS
    valid = rng.random(shape) < [1.0, 0.5, 0.5]
    speed = rng.normal(300.0, 5.0, shape)
    given = {
        "t_ns": START_NS + number * period_ns,
        "measured_speed_rad_s": np.where(rng.random(shape) < [0.0, 0.1, 0.1], np.nan, speed),
        "predicted_speed_rad_s": np.where(valid, rng.normal(300.0, 5.0, shape), np.nan),
        "band_variance": rng.uniform(1.0, 9.0, shape),
        "score": np.where(valid, rng.exponential(0.3, shape), np.nan),
        "valid": valid,
    }
    return filled(Score, *shape, period_ns=period_ns, **given)


def in_rows(score: Score) -> dict[int, Array]:
    """The values of a row by second, (columns, fans), computed one by one."""
    residual = np.where(score.valid, score.residual_rad_s, np.nan)
    half_width = np.where(score.valid, np.sqrt(score.band_variance), np.nan)
    means = (score.predicted_speed_rad_s, half_width, residual)
    found: dict[int, Array] = {}
    for second in np.unique(score.t_ns // 10**9).tolist():
        rows = score.t_ns // 10**9 == second
        kinds = [*((each, np.mean) for each in means), (residual, np.min), (residual, np.max), (score.score, np.max)]
        found[second] = np.array([[_of(values[rows, fan], kind) for fan in range(FANS)] for values, kind in kinds])
    return found


def _of(values: Array, kind: Callable[[Array], Any]) -> float:
    """The mean, least or largest of those that are known."""
    known = values[np.isfinite(values)].astype(np.float64)
    return float(kind(known)) if len(known) else np.nan


@pytest.mark.parametrize(("rate_hz", "seconds"), [(100.0, 45.0), (7.0, 60.0), (1.0, 90.0), (0.3, 400.0)])
def test_a_row_has_the_samples_of_its_second_however_scores_are_cut_and_messages_are_short(rate_hz, seconds):
    whole = scores(rate_hz, seconds)
    expected = in_rows(whole)
    rng = np.random.default_rng(5)
    for length in (1, 13, len(whole.t_ns)):
        rows, made = OverviewRows(), list[Overview]()
        at = 0
        while at < len(whole.t_ns):
            end = min(at + int(rng.integers(1, length + 1)), len(whole.t_ns))
            made += rows.add(cut(whole, at, end))
            at = end
        made += rows.so_far()
        found = join(made)
        assert found.t_ns.tolist() == [int(whole.t_ns[whole.t_ns // 10**9 == second].max()) for second in expected]
        for number, name in enumerate(VALUES):
            wanted = np.array([of_row[number] for of_row in expected.values()])
            np.testing.assert_allclose(getattr(found, name), wanted, rtol=1e-5, atol=1e-5, err_msg=name)
        assert all(each.t_ns[0] // MESSAGE_NS == each.t_ns[-1] // MESSAGE_NS for each in made)
        firsts = [int(each.t_ns[0]) // MESSAGE_NS for each in made]
        assert all(one < other for one, other in pairwise(firsts)), "no more messages than one in ten seconds"
    assert np.isnan(found.residual_rad_s[:, 1:]).any() == (rate_hz < 100.0), "a fan that was not judged is unknown"


def test_a_row_that_was_sent_early_comes_again_whole():
    score = scores(100.0, 2.7)
    middle = int(np.searchsorted(score.t_ns, START_NS + 1_000_000_000))
    rows = OverviewRows()
    early = [*rows.add(cut(score, 0, middle)), *rows.so_far()]
    assert rows.so_far()[0].t_ns.tolist() == [int(score.t_ns[middle - 1])]
    late = [*rows.add(cut(score, middle, len(score.t_ns))), *rows.so_far()]
    undisturbed = OverviewRows()
    whole = join([*undisturbed.add(score), *undisturbed.so_far()])
    assert join(early).t_ns[-1] == score.t_ns[middle - 1]
    assert np.array_equal(join(late).highest_residual_rad_s, whole.highest_residual_rad_s[1:])
