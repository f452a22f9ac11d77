"""A replay without a bus or a real clock: which messages are sent when, and the keys and their effect."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from typing import Any, cast

import pytest

from fantwin.pipeline.replay.live.keyboard import Key, Keys, keys_in
from fantwin.pipeline.replay.live.player import (
    BEAT_S,
    FASTEST,
    SLOWEST,
    Pace,
    Player,
    Progress,
    Stopped,
    faster,
    slower,
)
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.messages import NewTwin
from tests.support import made_messages
from tests.support.played_messages import FakeTime, Sent
from tests.support.replay_data import START_NS, STEP_NS, raw_of


class Script:
    """Keys at given moments, s since the start."""

    def __init__(self, time: FakeTime, *presses: tuple[float, Key]) -> None:
        self.time = time
        self.presses = list(presses)

    def __call__(self) -> list[Key]:
        due = [key for at_s, key in self.presses if at_s <= self.time.s - 50.0 + 1e-9]
        self.presses = self.presses[len(due) :]
        return due


def raws(count: int, period_ns: int = STEP_NS, samples: int = 1) -> list[tuple[int, Envelope]]:
    found = []
    for k in range(count):
        raw = raw_of(k * samples, 1, sequence=k, samples=samples)
        log_ns = START_NS + ((k + 1) * samples - 1) * period_ns
        found.append((0, Envelope.of("fantwin/demo/tray1/raw", raw, log_ns)))
    return found


def alarm(log_ns: int, sequence: int) -> Envelope:
    return Envelope.of("fantwin/demo/tray1/alarm", made_messages.alarm(0, log_ns, sequence=sequence), log_ns)


def play(
    rounds: Sequence[tuple[int, Envelope]],
    rate: float = 1.0,
    *,
    paused: bool = False,
    until_s: float = math.inf,
    cost_s: float = 0.0,
    look: Callable[[Progress], None] = lambda _progress: None,
    keys: Sequence[tuple[float, Key]] = (),
) -> tuple[Sent, Player]:
    time = FakeTime(until_s=50.0 + until_s)
    sent = Sent(time, cost_s=cost_s)
    pace, pressed = Pace(rate, paused=paused), Script(time, *keys)
    player = Player(cast(Any, sent), pace, time.wait, now_s=time.now_s, keys=pressed, look=look)
    player.play(rounds)
    return sent, player


@pytest.mark.parametrize(("rate", "apart_s"), [(1.0, 0.01), (0.1, 0.1), (8.0, 0.00125), (math.inf, 0.0)])
def test_messages_go_out_at_their_recorded_distances_over_the_rate(rate, apart_s):
    sent, player = play(raws(300), rate)
    assert [at_s for at_s, _, _ in sent.messages] == pytest.approx([k * apart_s for k in range(300)], abs=1e-6)
    assert player.last_ns - player.first_ns == 299 * STEP_NS
    assert player.ended_s - player.began_s == pytest.approx(299 * apart_s)


def test_the_time_that_publishing_takes_does_not_accumulate():
    sent, _ = play(raws(300), cost_s=0.004)
    assert sent.messages[-1][0] == pytest.approx(2.99)


def test_the_clock_is_published_twenty_times_a_second_and_health_once_a_second():
    sent, _ = play(raws(301))
    assert (sent.order[0], sent.clocks[0]) == ("clock", (0.0, 0, 1.0)), "before the first message"
    assert len(sent.clocks) == pytest.approx(3.0 / BEAT_S, abs=3)
    for at_s, t_ns, rate in sent.clocks:
        assert t_ns == pytest.approx(at_s * 1e9, abs=STEP_NS)
        assert rate == 1.0
    assert len(sent.healths) == 3 + 1 + 1  # once at the start, once at the end


def test_the_clock_waits_before_samples_that_are_still_to_come_however_late_their_message_was():
    sent, _ = play(raws(5, samples=100))
    oldest = [k * 100 * STEP_NS for k in range(5)]
    for at_s, t_ns, _ in sent.clocks:
        coming = [first for k, first in enumerate(oldest) if at_s < ((k + 1) * 100 - 1) / 100 - 0.99]
        assert all(t_ns <= first for first in coming)
    assert max(t_ns for _, t_ns, _ in sent.clocks) == oldest[-1]


def test_the_clock_continues_through_a_silence_of_the_link():
    silent = [*raws(10), (0, alarm(START_NS + 3 * 10**9, 0))]
    sent, _ = play(silent)
    assert [t_ns for at_s, t_ns, _ in sent.clocks if 1.0 < at_s < 2.0][-1] == pytest.approx(2e9, abs=6e7)


def test_the_published_time_never_runs_back():
    rounds = raws(4, samples=100)
    rounds.insert(1, (0, alarm(START_NS + 1_500_000_000, 0)))  # published before older samples
    sent, _ = play(rounds, keys=[(1.0, Key.FASTER), (1.2, Key.PAUSE), (1.5, Key.STEP), (1.6, Key.PAUSE)])
    times = [t_ns for _, t_ns, _ in sent.clocks]
    assert times == sorted(times)


def test_in_a_pause_only_clock_and_health_are_sent_and_recorded_time_stands_still():
    sent, player = play(raws(200), keys=[(0.5, Key.PAUSE), (60.5, Key.PAUSE)])
    during = [message for message in sent.messages if 0.56 < message[0] < 60.5]
    assert during == []
    assert len([at_s for at_s in sent.healths if 0.5 < at_s < 60.5]) >= 55
    standing = [(t_ns, rate) for at_s, t_ns, rate in sent.clocks if 0.6 < at_s < 60.4]
    assert len(standing) > 1000
    assert len(set(standing)) == 1
    assert standing[0][1] == 0.0
    assert player.ended_s - player.began_s == pytest.approx(61.99)
    assert sent.messages[-1][2] == 199


def test_a_step_is_one_message_of_the_first_topic_and_all_recorded_before_it():
    rounds = raws(10)
    rounds.insert(3, (0, alarm(START_NS + 2 * STEP_NS + 1, 0)))
    sent, _ = play(
        rounds, paused=True, keys=[(1, Key.STEP), (2, Key.STEP), (3, Key.STEP), (4, Key.STEP), (5, Key.PAUSE)]
    )
    by_second = [[topic for at_s, topic, _ in sent.messages if round(at_s) == second] for second in (1, 2, 3, 4)]
    assert by_second == [["raw"], ["raw"], ["raw"], ["alarm", "raw"]]
    reported = [t_ns for at_s, t_ns, _ in sent.clocks if 4.1 < at_s < 4.9]
    assert set(reported) == {3 * STEP_NS}


def test_a_twin_that_is_published_before_a_sample_is_no_step_of_its_own():
    twin = NewTwin(t_ns=START_NS, twin="t", sha256="", content=b"")
    first = (0, Envelope.of("fantwin/demo/tray1/new_twin", twin, START_NS))
    sent, _ = play([first, *raws(5)], paused=True, keys=[(1, Key.STEP), (2, Key.STEP), (3, Key.PAUSE)])
    by_second = [[topic for at_s, topic, _ in sent.messages if round(at_s) == second] for second in (1, 2)]
    assert by_second == [["new_twin", "raw"], ["raw"]]


def test_up_and_down_double_and_halve_the_rate_between_its_ends():
    sent, _ = play(raws(400), keys=[(1.0, Key.FASTER), (2.0, Key.SLOWER)])
    assert sent.messages[-1][0] == pytest.approx(2.99, abs=0.06)
    assert {rate for _, _, rate in sent.clocks} == {1.0, 2.0}
    assert (slower(SLOWEST), faster(FASTEST), slower(math.inf)) == (SLOWEST, math.inf, FASTEST)


@pytest.mark.parametrize("paused", [False, True])
def test_a_requested_end_takes_effect_at_once(paused):
    with pytest.raises(Stopped):
        play(raws(1000), paused=paused, until_s=2.345)
    with pytest.raises(Stopped):
        play(raws(1000), paused=paused, keys=[(3.0, Key.QUIT)])


def test_progress_is_reported_and_an_error_of_its_callback_ends_the_replay():
    seen: list[Progress] = []

    def look(progress: Progress) -> None:
        seen.append(progress)
        if progress.messages > 100:
            raise ValueError("enough")

    with pytest.raises(ValueError, match="enough"):
        play(raws(1000), look=look)
    assert seen[-1].t_ns == pytest.approx(START_NS + 1_000_000_000, abs=1e8)
    assert (seen[-1].rate, seen[-1].paused, seen[-1].round) == (1.0, False, 0)


@pytest.mark.parametrize(
    ("typed", "keys"),
    [
        (b" ", [Key.PAUSE]),
        (b"s\x1b[C\x1bOC", [Key.STEP] * 3),
        (b"\x1b[A\x1bOA", [Key.FASTER] * 2),
        (b"\x1b[B\x1bOB", [Key.SLOWER] * 2),
        (b"xyz\tq", [Key.QUIT]),
        (b"\x1b[Dq", [Key.QUIT]),
        (b"\x1b\x1b[A", [Key.FASTER]),
    ],
)
def test_keys_and_both_manners_of_arrows_are_known_and_all_else_is_passed_over(typed, keys):
    assert keys_in(typed) == keys


def test_without_a_terminal_there_are_no_keys(monkeypatch, tmp_path):
    with (tmp_path / "input").open("w+") as no_terminal:
        monkeypatch.setattr(sys, "stdin", no_terminal)
        keys = Keys()
        assert not keys.is_available
        with keys:
            assert keys.pressed() == []
