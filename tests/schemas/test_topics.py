"""The table of topics: complete, consistent, and invertible."""

import pytest

from fantwin.pipeline.runtime.stage import load_stage
from fantwin.schemas.topics import (
    BY_NAME,
    RESERVED_TRAY_NAMES,
    TOPICS,
    alive_key,
    health_key,
    topic_of,
    tray_key,
)
from tests.support.made_messages import MESSAGE_TYPES


def test_every_message_type_has_exactly_one_topic():
    assert [topic.message for topic in TOPICS] == list(MESSAGE_TYPES)
    assert len(BY_NAME) == len(TOPICS)


def test_the_topic_of_a_key_is_found():
    for topic in TOPICS:
        key = tray_key("plant", "tray1", topic.name)
        assert topic_of(health_key("plant", "scorer", "all") if topic.name == "health" else key) is topic


@pytest.mark.parametrize(
    "key",
    [
        "",
        "fantwin",
        "fantwin/plant/tray1/nothing",
        "other/plant/tray1/raw",
        "fantwin/plant/raw",
        alive_key("p", "s", "i"),
    ],
)
def test_a_foreign_key_is_no_topic(key):
    with pytest.raises(KeyError):
        topic_of(key)


def test_the_fixed_parts_of_keys_are_reserved_tray_names():
    assert health_key("s", "x", "y").split("/")[2] in RESERVED_TRAY_NAMES
    assert alive_key("s", "x", "y").split("/")[2] in RESERVED_TRAY_NAMES


def test_the_recorder_reads_every_recorded_topic():
    assert set(load_stage("recorder").reads) == {topic.name for topic in TOPICS if topic.recorded}
