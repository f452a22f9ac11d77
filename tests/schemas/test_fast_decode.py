"""Shortcuts for reading many messages: the same headers and columns as by decoding each message in full."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fantwin.schemas.codec import CodecError, decode_together, encode
from fantwin.schemas.enums import TachoKind
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.header import Header, InputPosition
from fantwin.schemas.messages import Raw, StatedTacho
from tests.support.made_messages import filled

KEY = "fantwin/plant/tray1/raw"


def raw(sequence: int, fans: int = 2, position: InputPosition | None = None) -> Raw:
    header = Header("acquisition-1", sequence, "tray1", position)
    columns = {"host_receive_t_ns": sequence + 5, "command": sequence / 7, "speed_rad_s": np.nan}
    return filled(Raw, 1, fans, header=header, **columns)


@pytest.mark.parametrize("length", [1, 100, 130])
def test_a_header_of_any_length_is_read_without_the_rest(length):
    message = raw(3, position=InputPosition("raw", "p" * length, 9, 10, 0))
    envelope = Envelope(KEY, "raw", encode(message) + b"\xff", 0)
    header = envelope.header
    assert (header.producer, header.sequence, header.tray) == ("acquisition-1", 3, "tray1")
    assert (header.input_position.producer, header.input_position.sequence) == ("p" * length, 9)
    with pytest.raises(CodecError):
        _ = envelope.message


@pytest.mark.parametrize("payload", [b"\x0a\x05\xff", b"\xff\xff\xff", b"\x0a\x02\xff\xff"])
def test_bytes_that_are_not_a_message_raise_a_codec_error(payload):
    with pytest.raises(CodecError):
        _ = Envelope(KEY, "raw", payload, 0).header


def test_what_every_message_of_a_block_states_is_stated_once_and_other_statements_are_kept_apart():
    tachos = (StatedTacho(TachoKind.AVERAGE, window_s=1.0), StatedTacho(TachoKind.COUNT, 2, 0.5))
    alike = [replace(raw(k), tachos=tachos) for k in range(5)]
    (block,) = decode_together(Raw, [encode(message) for message in alike])
    assert block.tachos == tachos and len(block.command) == 5
    mixed = [replace(raw(0), tachos=tachos), raw(1), replace(raw(2), tachos=tachos[:1])]
    blocks = decode_together(Raw, [encode(message) for message in mixed])
    assert [block.tachos for block in blocks] == [tachos, (), tachos[:1]]
