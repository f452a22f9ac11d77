"""What the fans of a tray have in common is subtracted; what one has by itself, and what is too much, is not."""

import numpy as np
import pytest

from schemas.messages import Array
from scoring.baseline.intervals import Intervals
from scoring.baseline.shared_offset import SharedOffset
from tests.support.one_interval import one_interval

SAMPLES = 10
ALL = np.ones(8, np.bool_)
STILL = np.zeros(1, np.bool_)
LIMIT, ADAPTATION_S, REACH_SIGMAS = 0.03, 300.0, 1.2
STATE = ("value", "compared", "commissioned", "informed", "searched")


def shared_offset(fans: int) -> SharedOffset:
    """Hardly drawn towards zero; the fans were commissioned at a high speed, and shared nothing."""
    return commissioned(of_residual_std(fans, 1e-3), 50.0)


def of_residual_std(fans: int, residual_std: float) -> SharedOffset:
    return SharedOffset(
        fans,
        limit=LIMIT,
        residual_std=residual_std,
        interval_s=1.0,
        adaptation_s=ADAPTATION_S,
        reach_sigmas=REACH_SIGMAS,
    )


def commissioned(shared: SharedOffset, speed_sigmas: float, share: float = 0.0) -> SharedOffset:
    """After the fans got their baselines at this speed."""
    fans = len(shared.columns()["counts"])
    for _ in range(10):
        turn(shared, np.full(fans, speed_sigmas), share, at_first=True)
    shared.begin_from_here()
    return shared


def turn(shared: SharedOffset, speed_sigmas: Array, share: float, *, at_first: bool = False) -> None:
    """An interval in which all fans, (fans,), turn, and share this."""
    speed, fans = np.tile(speed_sigmas, (SAMPLES, 1)), ALL[: len(speed_sigmas)]
    add(shared, share * speed, speed, np.ones(speed.shape, np.bool_))
    shared.end_interval(SAMPLES, fans, fans, STILL, at_first=at_first)


def add(shared: SharedOffset, offset: Array, speed_sigmas: Array, valid: Array) -> None:
    """Samples of the present interval."""
    everybody = np.ones(offset.shape[1], np.bool_)
    shared.take(shared.over(offset, speed_sigmas, valid, one_interval(len(offset)), everybody, None))


def at(shared: SharedOffset, speed_sigmas: Array) -> Array:
    return shared.columns()["value"] * speed_sigmas


def settled(offsets: list[float], *, valid: list[bool] | None = None, moving: list[bool] | None = None) -> float:
    """The shared offset after a minute of offsets of the fans, sigma, at a speed of 50 sigma."""
    shared = shared_offset(len(offsets))
    for _ in range(60):
        _take(shared, np.array(offsets), np.array(valid or [True] * len(offsets)))
        shared.end_interval(
            SAMPLES,
            ALL[: len(offsets)],
            ALL[: len(offsets)],
            np.array(moving or [False] * len(offsets)),
            at_first=False,
        )
    return float(at(shared, np.full((1, 1), 50.0))[0, 0])


def _take(shared: SharedOffset, offsets: Array, valid: Array) -> None:
    shape = (SAMPLES, len(offsets))
    add(shared, np.broadcast_to(offsets, shape), np.full(shape, 50.0), np.broadcast_to(valid, shape))


@pytest.mark.parametrize(
    ("offsets", "expected"),
    [
        ([-1.0, -1.2, -0.9, -1.1], -1.0),  # all: that of three of four at least
        ([-1.0, -1.2, -0.9, -9.0], -1.0),  # one is far off: as before
        ([0.0, 0.0, 0.0, -9.0], 0.0),  # only one is off
        ([-1.0, -1.2, 0.9, 1.1], 0.0),  # no majority in either direction
        ([-1.0, -1.2, -9.0], -1.2),  # the median of three
        ([-0.5, -9.0], -0.5),  # what both of two have
        ([0.5, -9.0], 0.0),
    ],
)
def test_it_is_what_most_fans_have_at_least(offsets: list[float], expected: float) -> None:
    assert settled(offsets) == pytest.approx(expected, abs=0.01)


def test_only_fans_count_that_turn_steadily_and_have_readings() -> None:
    offsets = [-1.0, -1.0, 1.0, 1.0, 1.0]
    assert settled(offsets) == pytest.approx(1.0, abs=0.01)
    assert settled(offsets, valid=[True, True, False, False, False]) == pytest.approx(-1.0, abs=0.01)
    assert settled(offsets, moving=[False, False, True, True, True]) == pytest.approx(-1.0, abs=0.01)


def test_it_is_limited_so_that_more_than_weather_is_left_to_be_found() -> None:
    assert settled([-4.0, -4.0, -4.0]) == pytest.approx(-LIMIT * 50.0)


def test_a_fan_that_becomes_faulty_leaves_the_other_as_it_was() -> None:
    shared = shared_offset(2)
    for _ in range(60):
        _take(shared, np.array([1.0, 1.2]), ALL[:2])
        shared.end_interval(SAMPLES, ALL[:2], ALL[:2], STILL, at_first=False)
    before = at(shared, np.full((1, 1), 50.0))[0, 0]
    for _ in range(60):
        _take(shared, np.array([1.0, -9.0]), ALL[:2])
        shared.end_interval(SAMPLES, ALL[:2], ALL[:2], STILL, at_first=False)
    assert before == pytest.approx(1.0, abs=0.01)
    assert at(shared, np.full((1, 1), 50.0))[0, 0] == pytest.approx(before, abs=0.01)


def test_errors_at_low_speed_are_not_taken_for_a_share_of_a_high_one() -> None:
    low, high = 10.0, 100.0
    shared = of_residual_std(4, 1.0)
    for _ in range(60):
        add(shared, np.full((SAMPLES, 4), -0.5), np.full((SAMPLES, 4), low), np.ones((SAMPLES, 4), np.bool_))
        shared.end_interval(SAMPLES, ALL[:4], ALL[:4], STILL, at_first=False)
    assert abs(at(shared, np.full((1, 1), high))[0, 0]) < 0.5  # and not -5


def test_a_fan_alone_is_followed_slowly_in_place_of_its_baseline_and_only_while_it_is_well() -> None:
    shared, one, first = shared_offset(3), np.full((1, 1), 50.0), np.array([True, False, False])
    for _ in range(round(ADAPTATION_S)):
        _take(shared, np.full(3, 1.0), first)
        assert shared.end_interval(SAMPLES, ALL[:3], ALL[:3], STILL, at_first=False).tolist() == [True, False, False]
    followed = at(shared, one)[0, 0]
    assert followed == pytest.approx(1.0 - np.exp(-1.0), abs=0.01)
    for _ in range(100):
        _take(shared, np.full(3, 1.0), first)
        shared.end_interval(SAMPLES, ALL[:3], ~ALL[:3], STILL, at_first=False)
    assert at(shared, one)[0, 0] == followed
    _take(shared, np.full(3, 1.0), ALL[:3])
    assert not shared.end_interval(SAMPLES, ALL[:3], ALL[:3], STILL, at_first=False).any()
    assert at(shared, one)[0, 0] > followed + 0.03  # with others at once
    value = at(shared, one)[0, 0]
    shared.restart(first)
    shared.restart(ALL[:3])
    assert at(shared, one)[0, 0] == value


def test_a_fan_alone_is_followed_no_further_than_its_baseline_would_be() -> None:
    shared = shared_offset(3)
    for _ in range(round(10 * ADAPTATION_S)):
        _take(shared, np.full(3, -9.0), np.array([True, False, False]))
        shared.end_interval(SAMPLES, ALL[:3], ALL[:3], STILL, at_first=False)
    assert at(shared, np.full((1, 1), 50.0))[0, 0] == pytest.approx(-REACH_SIGMAS)


def test_the_only_fan_of_a_tray_with_several_channels_keeps_its_own_baseline() -> None:
    shared, only = shared_offset(3), np.array([True, False, False])
    _take(shared, np.full(3, -1.0), only)
    assert not shared.end_interval(SAMPLES, only, ALL[:3], STILL, at_first=False).any()
    assert at(shared, np.full((1, 1), 50.0))[0, 0] == 0.0


def test_it_stays_when_all_fans_are_commissioned_again_and_its_limit_is_from_there() -> None:
    shared, too_much = shared_offset(3), 2.5 * LIMIT * 50.0

    def settle() -> float:
        for _ in range(120):
            _take(shared, np.full(3, too_much), ALL[:3])
            shared.end_interval(SAMPLES, ALL[:3], ALL[:3], STILL, at_first=False)
        return float(shared.columns()["value"][0])

    assert settle() == LIMIT == pytest.approx(shared.since_commissioning)
    shared.restart(np.array([True, True, False]))
    assert settle() == LIMIT, "some of the fans"
    shared.restart(ALL[:3])
    assert (shared.columns()["value"][0], shared.since_commissioning) == (LIMIT, 0.0)
    commissioned(shared, 50.0, LIMIT)
    assert settle() == 2 * LIMIT
    assert shared.since_commissioning == pytest.approx(LIMIT)


def test_idling_fans_say_nothing_about_what_fast_ones_share() -> None:
    shared = commissioned(of_residual_std(4, 1.0), 100.0)
    speed_sigmas = np.array([10.0, 10.0, 100.0, 100.0])
    for _ in range(60):
        turn(shared, speed_sigmas, 0.02)
    assert shared.columns()["value"][0] == pytest.approx(0.02, rel=0.15)


def test_what_fans_shared_when_they_were_commissioned_idling_is_found_when_they_turn_fast() -> None:
    shared, share = of_residual_std(4, 1.0), 1.8 * LIMIT
    commissioned(shared, 20.0, share)
    for _ in range(1000):
        turn(shared, np.full(4, 100.0), share)
    assert shared.columns()["value"][0] == pytest.approx(share, rel=0.1)
    before = shared.columns()["commissioned"][0]
    for _ in range(1000):
        turn(shared, np.full(4, 100.0), 4.0 * LIMIT)
    assert shared.columns()["commissioned"][0] == before, "once it is known, it stays"
    assert shared.columns()["value"][0] == pytest.approx(before + LIMIT)


def test_many_intervals_at_once_are_the_same_as_one_after_the_other() -> None:
    rng, intervals, fans = np.random.default_rng(1), 900, 4
    speed = np.repeat(rng.choice([15.0, 90.0], (intervals, fans)), SAMPLES, axis=0)
    offset = 0.02 * speed + rng.normal(0.0, 0.3, speed.shape)
    valid = np.repeat(rng.random((intervals, fans)) < 0.9, SAMPLES, axis=0)
    valid[:, :2] = True
    one, many = (commissioned(of_residual_std(fans, 1.0), 15.0, 0.02) for _ in range(2))
    once = many.over(
        offset,
        speed,
        valid,
        Intervals(np.arange(intervals) * SAMPLES, len(speed), SAMPLES),
        ALL[:fans],
        np.zeros((intervals, fans), np.bool_),
    )
    states = []
    for k in range(once.ends):
        states.append([float(one.columns()[name][0]) for name in STATE])
        rows = slice(k * SAMPLES, (k + 1) * SAMPLES)
        add(one, offset[rows], speed[rows], valid[rows])
        one.end_interval(SAMPLES, ALL[:fans], ALL[:fans], STILL, at_first=False)
    assert once.ends == intervals
    together = once.states[: once.ends]
    np.testing.assert_array_equal(together, states)
    assert states[0][3] == 0.0, "it is still being found at first"
    assert states[-1][3] == states[-100][3] >= 60.0, "and known at last"


def test_fans_commissioned_again_one_by_one_begin_from_where_they_are_then() -> None:
    shared = commissioned(of_residual_std(4, 1.0), 100.0, 0.01)
    for fan in range(4):
        shared.restart(np.arange(4) == fan)
    commissioned(shared, 15.0, 0.02)
    begun = shared.columns()["begun_information"][0]
    assert 0.1 < begun < 0.3, "of the last commissioning only"
    for _ in range(600):
        turn(shared, np.full(4, 100.0), 0.02)
    assert shared.columns()["commissioned"][0] == pytest.approx(0.02, rel=0.15)
    assert shared.since_commissioning == pytest.approx(0.0, abs=0.003)


def test_turning_backwards_is_slowed_by_the_same_air() -> None:
    shared = shared_offset(2)
    for _ in range(60):
        add(
            shared,
            np.tile([-1.0, 1.0], (SAMPLES, 1)),
            np.tile([50.0, -50.0], (SAMPLES, 1)),
            np.ones((SAMPLES, 2), bool),
        )
        shared.end_interval(SAMPLES, ALL[:2], ALL[:2], STILL, at_first=False)
    np.testing.assert_allclose(at(shared, np.array([[50.0, -50.0]])), [[-1.0, 1.0]], atol=0.01)


def test_it_continues_from_a_snapshot() -> None:
    before, after = shared_offset(3), shared_offset(3)
    _take(before, np.full(3, 1.0), np.ones(3, np.bool_))
    before.end_interval(SAMPLES, ALL[:3], ALL[:3], STILL, at_first=False)
    _take(before, np.full(3, 1.0), np.ones(3, np.bool_))
    after.restore(before.snapshot())
    for shared in (before, after):
        shared.end_interval(SAMPLES, ALL[:3], ALL[:3], STILL, at_first=False)
    np.testing.assert_array_equal(at(before, np.ones((1, 1))), at(after, np.ones((1, 1))))
    assert at(before, np.ones((1, 1)))[0, 0] > 0.0
    assert after.snapshot() == before.snapshot()
