"""The recording that `fantwin replay --offline -o` writes: the raw samples used and everything computed from them, each
sample once."""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.recordings.metadata import recording_metadata
from fantwin.pipeline.recordings.records import active_path
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.pipeline.replay.offline.replay_input import ReplayInput
from fantwin.schemas.blocks import cut
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Grid, Message, Prediction, Raw, Request, Score, newest_t_ns
from fantwin.schemas.topics import TOPICS, tray_key

MESSAGE_SAMPLES = 100
"""samples a message: few, for a player that steps by messages and for a file that is truncated"""
_TOPIC_OF = {topic.message: topic.name for topic in TOPICS}


def output_writer(replay_input: ReplayInput, output: Path) -> RecordingWriter:
    """The writer of a new recording, with the configuration and the twins that are used.

    Raises:
        UserError: the file exists.
        RecordingError: it cannot be written.
    """
    for path in (output, active_path(output)):
        if path.exists():
            raise UserError(f"{path}: exists already; name another file with -o, or remove it")
    contexts = [replay_input.contexts(tray)[-1] for tray in replay_input.trays]
    metadata, attachments = recording_metadata(replace(contexts[0], trays=tuple(context.tray for context in contexts)))
    metadata["source"] = ",".join(path.name for path in replay_input.paths)
    return RecordingWriter(output, metadata, attachments)


class TrayOutput:
    """Writes the messages of one tray."""

    def __init__(self, writer: RecordingWriter, site: str, tray: str) -> None:
        self._writer = writer
        self._site = site
        self._tray = tray
        self._sequences: Counter[str] = Counter()
        self._requests: set[Header] = set()
        self._newest_t_ns: dict[type[Message], int] = defaultdict(lambda: np.iinfo(np.int64).min)

    def add(self, message: Message) -> None:
        """Write a message, without the samples that an earlier session has made already."""
        if isinstance(message, Grid | Prediction | Score):
            first = int(np.searchsorted(message.t_ns, self._newest_t_ns[type(message)], side="right"))
            if first == len(message.t_ns):
                return
            message = cut(message, first, len(message.t_ns))
            self._newest_t_ns[type(message)] = int(message.t_ns[-1])
        if isinstance(message, Raw | Grid | Prediction | Score):
            samples = len(message.command)
            for first in range(0, samples, MESSAGE_SAMPLES):
                self._write(cut(message, first, min(first + MESSAGE_SAMPLES, samples)))
        else:
            self._write(message)

    def _write(self, message: Message) -> None:
        topic = _TOPIC_OF[type(message)]
        header = Header(f"offline-{topic}", self._sequences[topic], self._tray)
        if isinstance(message, Request):  # alarms refer to it by its own producer and sequence number
            header = message.header
            if header in self._requests:
                return
            self._requests.add(header)
        self._sequences[topic] += 1
        key = tray_key(self._site, self._tray, topic)
        self._writer.add_message(key, replace(message, header=header), newest_t_ns(message))
