"""One message with its key, its bytes and its time of receipt: what a bus delivers and a recording holds."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

from fantwin.schemas.codec import decode, decode_header, encode
from fantwin.schemas.messages import Message, newest_t_ns
from fantwin.schemas.topics import BY_NAME, topic_of


@dataclass(slots=True)
class Envelope:
    """One message as it came off the bus or out of a recording.

    `topic` is the name of its topic, `payload` the protobuf bytes of `message`, `received_t_ns` host time in ns since
    the epoch. The payload is decoded when `message` is first read: readers of whole recordings need few of them, and
    `header` is read without the rest.
    """

    key: str
    topic: str
    payload: bytes
    received_t_ns: int
    _message: Message | None = field(default=None, compare=False, repr=False)
    _newest_t_ns: int | None = field(default=None, compare=False, repr=False)
    _header: Any = field(default=None, compare=False, repr=False)

    @classmethod
    def of(cls, key: str, message: Message, received_t_ns: int) -> Envelope:
        """The envelope of a message that has not been encoded yet."""
        return cls(key, topic_of(key).name, encode(message), received_t_ns, message)

    @property
    def message(self) -> Message:
        """The decoded payload. Raises CodecError."""
        if self._message is None:
            self._message = decode(BY_NAME[self.topic].message, self.payload)
        return self._message

    @property
    def header(self) -> Any:
        """The header of the message, without decoding the rest: `Header`, or `fan_pb2.Header`. Raises CodecError."""
        if self._message is not None:
            return self._message.header
        if self._header is None:
            self._header = decode_header(BY_NAME[self.topic].message, self.payload)
        return self._header

    @property
    def newest_t_ns(self) -> int:
        """Time of the message's newest sample or event, ns since the epoch. Raises CodecError.

        A recording states it beside the message (0 for times before 1970), so nothing is decoded there.
        """
        return newest_t_ns(self.message) if self._newest_t_ns is None else self._newest_t_ns

    def received_at(self, t_ns: int) -> Envelope:
        """The same message with another time of receipt."""
        return replace(self, received_t_ns=t_ns)
