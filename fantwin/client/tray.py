"""One tray whose samples a client publishes.

Samples wait in a queue and are sent by a thread: a program that publishes is never held up by the network. Acquisition
says in its health what it has received; until then a message can be asked for again, also by an acquisition that was
restarted. So each sample that `publish` takes arrives once, or is counted.
"""

from __future__ import annotations

import logging
import secrets
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from fantwin.client import errors
from fantwin.client.losses import WITHOUT_SPEED, CountsOfAcquisition, Losses
from fantwin.client.outbox import Outbox
from fantwin.client.times import Time, times_ns
from fantwin.pipeline.acquisition.acquisition_watch import TrayAcquisition
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.sources.source import limits_of_float32
from fantwin.schemas.channels import BY_NAME as CHANNELS_BY_NAME
from fantwin.schemas.codec import encode, type_name
from fantwin.schemas.header import Header
from fantwin.schemas.health import AcceptedSamples, Health
from fantwin.schemas.messages import PushedSamples
from fantwin.schemas.topics import BY_NAME, tray_key
from fantwin.schemas.units import NS_PER_S, RAD_S_PER_UNIT, SpeedUnit

Values: TypeAlias = float | Sequence[float] | Sequence[Sequence[float]] | NDArray[Any]
READING = "reading"
"""the topic of pushed samples"""
WATCH_S = 0.5
"""how often the thread looks by itself whether acquisition is there"""
ASK_AGAIN_S = 2.0
"""after this long without a confirmation a message without samples shows acquisition what it may have missed"""
ROOM_S = 5.0
"""how long `publish` waits for room while acquisition works"""
_LOG = logging.getLogger(__name__)


class Tray:
    """Made by `Client.tray`. Its methods may be called from any thread."""

    def __init__(
        self, bus: Bus, site: str, name: str, speed_unit: SpeedUnit, kept_samples: int, timeout_s: float
    ) -> None:
        """See `Client.tray`."""
        if speed_unit not in RAD_S_PER_UNIT:
            raise errors.ClientError(f"speed_unit {speed_unit!r} is not known; known: {', '.join(RAD_S_PER_UNIT)}")
        self.name = name
        self._site = site
        self._rad_s_per_unit = RAD_S_PER_UNIT[speed_unit]
        self._kept_samples = kept_samples
        self._changed = threading.Condition()
        self._stopped = self._has_news = False
        self._failure: Exception | None = None
        """what has ended the thread"""
        self._outbox = Outbox()
        self._published = self._not_kept = 0
        self._newest_t_ns: int | None = None
        self._line = 0
        self._is_away = False
        """whether it was said that acquisition has gone"""
        self._reported = Losses(0, 0, 0, 0)
        """the losses of the last check"""
        self._producer = f"client-{name}-{secrets.token_hex(2)}-{bus.id}"
        self._key = tray_key(site, name, READING)
        self._acquisition = TrayAcquisition(bus, site, name, self._on_change)
        try:
            first, self._accepts = self._first_health(timeout_s)
        except BaseException:
            self._acquisition.close()  # a program may try for as long as it runs
            raise
        self._counts = CountsOfAcquisition(first)
        self._publisher = bus.publisher(self._key, BY_NAME[READING], type_name(PushedSamples), self._producer)
        self._thread = threading.Thread(target=self._send_all, name=f"send {name}", daemon=True)
        self._thread.start()

    @property
    def fans(self) -> int:
        """Number of fans of the tray, as the configuration of the site says."""
        return self._accepts.fans

    @property
    def fan_names(self) -> tuple[str, ...]:
        """Name of each fan in the configuration of the site; empty for a fan without one."""
        return tuple(map(self._accepts.names.name, range(self.fans)))

    def publish(
        self,
        t: Time | Sequence[Time] | NDArray[Any],
        command: Values,
        speed: Values,
        **measured: Values,
    ) -> None:
        """Publish one sample of all fans, or several.

        t: by the clock of the caller: seconds since 1970 as float, nanoseconds as int, or dates with a time zone; of
        one sample or of n. It need not be the clock of the site (docs/explanation/time.md), but it must go on.
        command, speed: one value for each fan, in the tray's command unit and in `speed_unit`; of n samples (n, fans).
        The command is the one applied from `t` on. A speed of NaN was not measured.
        measured: likewise, what else is measured, by the name of its channel (docs/reference/messages.md), such as
        supply_voltage_v; one number is for all fans.

        It returns at once. While acquisition works but is behind, it waits for room, at most 5 s.

        Raises:
            FanCountError, CommandError, TimeOrderError: the values cannot be samples of this tray.
            NotKeptError: there is no room: acquisition is gone, or behind for longer.
            SendError: the thread that sends has failed; nothing was taken.
        """
        times = times_ns(t)
        commands, speeds = self._by_fan(command, len(times), "command"), self._by_fan(speed, len(times), "speed")
        self._check_commands(commands)
        if unknown := measured.keys() - CHANNELS_BY_NAME:
            raise TypeError(f"no channel {min(unknown)}; known: {', '.join(CHANNELS_BY_NAME)}")
        others: dict[str, Any] = {
            name: np.full((len(times), self.fans), values, np.float32)
            if np.ndim(values) == 0
            else self._by_fan(values, len(times), name).astype(np.float32)
            for name, values in measured.items()
        }
        with self._changed:
            self._check_thread()
            self._check_times(times)
            self._wait_for_room(len(times))
            self._check_times(times)  # another thread may have published meanwhile
            rad_s = speeds * self._rad_s_per_unit
            samples = PushedSamples(fans=self.fans, t_ns=times, command=commands, speed_rad_s=rad_s, **others)
            self._outbox.add(samples, self._line)
            self._published += len(times)
            self._newest_t_ns = int(times[-1]) if len(times) else self._newest_t_ns
            self._wake()

    def restart_time(self) -> None:
        """The clock of the caller was set: the next sample may have an earlier time. To the site it is a new clock."""
        with self._changed:
            self._newest_t_ns = None
            self._line += 1

    def losses(self) -> Losses:
        """What became of the samples, as far as acquisition has reported it: it does so several times a second."""
        with self._changed:
            outbox, counts = self._outbox, self._counts
            return Losses(
                published=self._published,
                received=outbox.received,
                waiting=outbox.samples,
                not_kept=self._not_kept,
                refused=counts.refused(),
                lost=counts.lost(),
                absurd_speeds=counts.of(WITHOUT_SPEED),
            )

    def check(self, timeout_s: float = 5.0) -> Losses:
        """Wait until acquisition has received all samples that were published, and return what became of them.

        Raises:
            NotReceivedError: it has not received all of them in time.
            SendError: the thread that sends has failed.
            SamplesLostError: since the last check samples were refused or lost, or not kept.
        """
        self.wait_received(timeout_s)
        losses, before = self.losses(), self._reported
        self._reported = losses
        if (losses.not_kept, losses.refused, losses.lost) != (before.not_kept, before.refused, before.lost):
            problem = self._problem_of_acquisition()
            raise errors.SamplesLostError(f"tray {self.name}: {losses}{f'; {problem}' if problem else ''}")
        return losses

    def wait_received(self, timeout_s: float) -> None:
        """Wait until acquisition has received all samples that were published.

        Raises:
            NotReceivedError: it has not received all of them in time.
            SendError: the thread that sends has failed.
        """
        with self._changed:
            is_received = self._changed.wait_for(lambda: not self._outbox.samples or self._failure, timeout_s)
            self._check_thread()
            if not is_received:
                raise errors.NotReceivedError(
                    f"tray {self.name}: acquisition has not received {self._outbox.samples} of {self._published} "
                    f"samples: {self._why_waiting()}"
                )

    def stop(self) -> None:
        """End the thread. What was not sent stays unsent."""
        with self._changed:
            self._stopped = True
            self._wake()
        self._thread.join(WATCH_S)

    def _first_health(self, timeout_s: float) -> tuple[Health, AcceptedSamples]:
        until_s = time.monotonic() + timeout_s
        health = None
        while True:
            if self._acquisition.watch_health() and (health := self._acquisition.health()):
                break
            left_s = until_s - time.monotonic()
            if left_s <= 0:
                what = "says nothing" if self._acquisition.at_work() else "is at work"
                who = "the acquisition" if self._acquisition.at_work() else "no acquisition"
                raise errors.NoAcquisitionError(
                    f"{who} of tray {self.name} of site {self._site} {what}: is `fantwin up` running there, with such "
                    "a tray?"
                )
            with self._changed:
                self._changed.wait(min(left_s, WATCH_S))
        accepts = self._accepted(health)
        if accepts is None:
            raise errors.NoAcquisitionError(
                f'tray {self.name} takes no pushed samples: write source = {{ kind = "push" }} in its [[tray]]'
            )
        return health, accepts

    def _accepted(self, health: Health) -> AcceptedSamples | None:
        return next((each for each in health.accepts if each.tray == self.name), None)

    def _by_fan(self, values: Values, samples: int, what: str) -> NDArray[np.float64]:
        """(samples, fans) of float64."""
        array, fans = np.array(values, np.float64), self.fans
        if array.ndim < 2 and array.size == samples * fans and 1 in (samples, fans):
            return array.reshape(samples, fans)
        if array.shape != (samples, fans):
            raise errors.FanCountError(
                f"tray {self.name}: {what} has shape {array.shape}; {samples} samples of {fans} fans have shape "
                f"{(samples, fans)}"
            )
        return array

    def _check_commands(self, commands: NDArray[np.float64]) -> None:
        low, high = self._accepts.command_min, self._accepts.command_max
        least, most = limits_of_float32(low, high)
        wrong = ~((commands >= least) & (commands <= most))  # NaN is in no range
        if wrong.any():
            row, fan = np.argwhere(wrong)[0].tolist()
            which = f"{commands[row, fan]:g} of {self._accepts.names.label(fan)}, sample {row}"
            raise errors.CommandError(
                f"tray {self.name}: command {which}: a command must be known and within command_min = {low:g} to "
                f"command_max = {high:g}"
            )

    def _check_thread(self) -> None:
        if self._failure is not None:
            what = f"{type(self._failure).__name__}: {self._failure}"
            raise errors.SendError(
                f"tray {self.name}: nothing is sent any more: {what}; open the client again"
            ) from self._failure

    def _check_times(self, times: NDArray[np.int64]) -> None:
        before = times[:1] - 1 if self._newest_t_ns is None else np.array([self._newest_t_ns])
        steps = np.diff(times, prepend=before)
        if np.any(steps <= 0):
            row = int(np.argmax(steps <= 0))
            raise errors.TimeOrderError(
                f"tray {self.name}: the time of sample {row} is {-int(steps[row]) / NS_PER_S:g} s before the last one, "
                "or the same: times must increase; after the clock was set, call restart_time()"
            )

    def _wait_for_room(self, samples: int) -> None:
        def has_room() -> bool:
            return self._outbox.samples + samples <= self._kept_samples

        if has_room():
            return
        until_s = time.monotonic() + ROOM_S
        while samples <= self._kept_samples and self._acquisition.at_work() and time.monotonic() < until_s:
            if self._changed.wait_for(has_room, WATCH_S):
                return
        self._not_kept += samples
        raise errors.NotKeptError(
            f"tray {self.name}: {self._outbox.samples} samples wait for acquisition, and {self._kept_samples} are kept "
            f"at most: {self._why_waiting()}; {samples} samples were not taken"
        )

    def _why_waiting(self) -> str:
        if not self._acquisition.at_work():
            return "acquisition is gone: is the site running, and the network up?"
        return self._problem_of_acquisition() or "acquisition is behind"

    def _problem_of_acquisition(self) -> str:
        health = self._acquisition.health()
        return health.problem if health else ""

    def _on_change(self) -> None:
        with self._changed:
            self._wake()

    def _wake(self) -> None:
        """Let the thread look at everything again; the lock is held."""
        self._has_news = True
        self._changed.notify_all()

    def _send_all(self) -> None:
        """The thread. What ends it is raised by `publish` and `check`."""
        try:
            self._send_until_stopped()
        except Exception as error:  # noqa: BLE001  nobody would see it
            with self._changed:
                self._failure = error
                self._wake()

    def _send_until_stopped(self) -> None:
        """Sends while acquisition is at work, and takes what that confirms."""
        heard: Health | None = None
        asked_s = time.monotonic()
        while True:
            self._has_news = False  # what comes from now on is seen in the next round
            is_there = self._acquisition.watch_health() is not None
            health = self._acquisition.health()
            if health is not None and health is not heard:
                heard = health
                if self._take_health(health):
                    asked_s = time.monotonic()
            self._note_presence(is_there)
            with self._changed:
                if self._stopped:
                    return
                outbox = self._outbox
                if is_there and outbox.may_send and outbox.waiting:
                    message = outbox.take()
                elif is_there and outbox.may_send and outbox.sent and time.monotonic() - asked_s > ASK_AGAIN_S:
                    asked_s = time.monotonic()
                    message = PushedSamples(fans=self.fans, first_number=self._published)
                else:
                    self._changed.wait_for(lambda: self._has_news, WATCH_S)
                    continue
            self._send(message)

    def _send(self, message: PushedSamples) -> None:
        sequence = self._publisher.published
        payload = encode(replace(message, header=Header(self._producer, sequence, self.name)))
        with self._changed:
            self._outbox.add_sent(sequence, len(message.t_ns), len(payload))
        self._publisher.put(payload)

    def _take_health(self, health: Health) -> bool:
        """What acquisition says of this client; whether it has received more."""
        with self._changed:
            self._counts.add(health, self._key, self._producer)
            self._accepts = self._accepted(health) or self._accepts
            line = next((x for x in health.inputs if (x.key, x.producer) == (self._key, self._producer)), None)
            if line is None:
                return False
            before = line.next_sequence - line.unsaved
            is_news = self._outbox.confirm(before)
            if is_news:
                self._changed.notify_all()
        self._publisher.forget(before)
        return is_news

    def _note_presence(self, is_there: bool) -> None:
        if is_there is self._is_away:
            self._is_away = not is_there
            if is_there:
                _LOG.warning("tray %s: acquisition is back", self.name)
            else:
                _LOG.warning("tray %s: acquisition is gone; up to %d samples are kept", self.name, self._kept_samples)
