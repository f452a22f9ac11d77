"""Notifier: sends messages about alarms to people elsewhere (docs/how-to/notify.md).

Reads `alarm` and writes nothing. One core serves all trays. Transitions go into the history of alarms; what is to be
sent is decided in their order and saved there; a thread for each target delivers it.
"""

from __future__ import annotations

import sqlite3
import time
from collections import Counter
from collections.abc import Mapping, Sequence

from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.outputs.notify.alertmanager import AlertSender
from fantwin.pipeline.outputs.notify.config import NotifierConfig
from fantwin.pipeline.outputs.notify.notification_flow import Changes, Notifications
from fantwin.pipeline.outputs.notify.outbox import Outbox
from fantwin.pipeline.outputs.notify.sending import TargetThread
from fantwin.pipeline.outputs.notify.targets import problems_of, sender_of
from fantwin.pipeline.outputs.notify.wording import Place
from fantwin.pipeline.runtime.stage import BuiltStage, Context, Core, Stage, StageError
from fantwin.pipeline.site.alarm_history import FILE
from fantwin.pipeline.site.one_line import readable_alarm
from fantwin.schemas.messages import Alarm, Message
from fantwin.schemas.topics import ALL_TRAYS
from fantwin.schemas.units import NS_PER_S

EXPIRY_PERIOD_NS = 60 * NS_PER_S
"""time between two searches for messages that have waited too long"""
ALERTS_PERIOD_NS = NS_PER_S
SAVED_AGAIN_AFTER_NS = NS_PER_S
"""a full disk is tried again"""
READ_AT_ONCE = 1000
"""transitions"""
STOPPED_WITHIN_S = 3.0
"""deliveries that are under way"""


class NotifierCore(Core):
    """Decides and saves; the senders deliver."""

    def __init__(
        self,
        config: NotifierConfig,
        trays: Sequence[TrayConfig],
        notifications: Notifications,
        outbox: Outbox,
        senders: Mapping[str, TargetThread],
    ) -> None:
        """senders: by target; they are started here."""
        self._config = config
        self._fans = {tray.name: tray.fans for tray in trays}
        self._notifications = notifications
        self._outbox = outbox
        self._senders = senders
        self._counts: Counter[str] = Counter()
        self._now_ns = 0
        self._saved_ns = self._alerts_ns = self._failed_ns = 0
        self._saving = ""
        self._has_news = False
        for sender in senders.values():
            sender.start()

    def step(self, item: Message) -> Sequence[Message]:
        """Keep a transition of an alarm."""
        if not isinstance(item, Alarm):
            return ()
        if not 0 <= item.fan < self._fans.get(item.header.tray, 0):
            self._counts["unknown_fan"] += 1
            return ()
        alarm = readable_alarm(item)
        self._outbox.hear(alarm)
        if self._notifications.is_looking:  # it may be one that the history had before
            self._notifications.add(alarm, self._now_ns)
        return ()

    def tick(self, now_ns: int) -> Sequence[Message]:
        """Decide what transitions and the time bring, and save it."""
        self._now_ns = now_ns
        news = self._read(now_ns)
        self._notifications.tick(now_ns)
        if self._notifications.is_looking:
            return ()
        self._has_news |= news
        is_expiry_due = abs(now_ns - self._saved_ns) >= EXPIRY_PERIOD_NS
        may_save = not self._saving or abs(now_ns - self._failed_ns) >= SAVED_AGAIN_AFTER_NS
        if may_save and (self._notifications.changes or self._has_news or is_expiry_due):
            self._save(now_ns)
        if abs(now_ns - self._alerts_ns) >= ALERTS_PERIOD_NS:
            self._alerts_ns = now_ns
            for target in self._config.target:
                sender = self._senders[target.name]
                if isinstance(sender, AlertSender):
                    sender.want(self._notifications.firing(target))
        return ()

    def close(self) -> Sequence[Message]:
        """Save, end the deliveries, and leave a complete file. What waits is sent after the next start."""
        self._has_news |= self._read(self._now_ns)
        if (self._notifications.changes or self._has_news) and not self._notifications.is_looking:
            self._save(self._now_ns)
        self.abort()
        return ()

    def abort(self) -> None:
        """The same after a crash, without saving."""
        until_s = time.monotonic() + STOPPED_WITHIN_S
        for sender in self._senders.values():
            sender.stop(0.0)
        for sender in self._senders.values():
            sender.stop(max(0.0, until_s - time.monotonic()))
        self._outbox.close()

    def counters(self) -> Mapping[str, int]:
        """Messages sent, waiting and lost, and attempts."""
        lost = sum(self._outbox.lost.values())
        return {
            "messages_sent": sum(sender.sent for sender in self._senders.values()),
            "attempts": sum(sender.attempts for sender in self._senders.values()),
            "messages_waiting": self._outbox.count(),
            **({"lost_messages": lost} if lost else {}),
            **self._counts,
        }

    def problem(self) -> str:
        """Problem of the targets or the outbox."""
        lost = [
            f"target {name}: messages were lost: too old, too many, or refused" for name in sorted(self._outbox.lost)
        ]
        return "; ".join(
            filter(None, (self._outbox.problem, self._saving, *(s.problem() for s in self._senders.values()), *lost))
        )

    def notes(self) -> Sequence[str]:
        """Number of fans that wait for the end of quiet hours, or for others that go into the same message."""
        return [
            f"target {target}: {count} {'fan' if count == 1 else 'fans'} wait for the next message ({basket})"
            for (target, basket), count in self._notifications.waiting().items()
        ]

    def _read(self, now_ns: int) -> bool:
        """Decide what the transitions bring that came to the history; returns whether there were any."""
        news = self._outbox.news(READ_AT_ONCE)
        for alarm in news:
            if 0 <= alarm.fan < self._fans.get(alarm.header.tray, 0):  # another configuration may have had more
                self._notifications.add(alarm, now_ns)
        return bool(news)

    def _save(self, now_ns: int) -> None:
        """Save the decisions; what cannot be saved is tried again."""
        changes = self._notifications.changes
        try:
            self._outbox.save(self._notifications.saved, changes, now_ns)
        except sqlite3.Error as error:
            self._failed_ns = now_ns
            self._saving = f"messages cannot be saved, and are not sent before they are: {error}"
            return
        self._saving, self._saved_ns, self._has_news = "", now_ns, False
        self._notifications.changes = Changes()
        for outgoing in changes.outgoing:
            self._senders[outgoing.target].wake()


def build(context: Context) -> BuiltStage:
    """Read the secrets of the targets, open the outbox, and start to send what it has.

    Raises:
        StageError: the extra is not installed, a secret cannot be read, or the outbox cannot be read or written.
    """
    config: NotifierConfig = context.config
    if problems := check(context):
        raise StageError("; ".join(problems))
    place = Place(context.site, config.page)
    outbox = Outbox(context.own_file(FILE), [target.name for target in config.target])
    fans = {tray.name: tray.fans for tray in context.trays}
    saved, past = outbox.load()
    past = [alarm for alarm in past if alarm.fan < fans.get(alarm.header.tray, 0)]
    notifications = Notifications(config, place, saved, past)
    senders = {target.name: sender_of(target, context.resolve, outbox, place) for target in config.target}
    return BuiltStage(NotifierCore(config, context.trays, notifications, outbox, senders))


def check(context: Context) -> list[str]:
    """Report a missing extra, a URL that apprise cannot use, and files of secrets that cannot be read."""
    config: NotifierConfig = context.config
    # a shard does not know the trays of the others
    trays = tuple(tray.name for tray in context.trays) if context.instance == ALL_TRAYS else None
    return problems_of(config, trays, context.resolve)


STAGE = Stage(
    row=STAGES["notifier"],
    about="sends mails, chat messages and alerts about alarms",
    config=NotifierConfig,
    build=build,
    core_per_tray=False,
    check=check,
)
