"""Small logs of other systems, written for tests: ULog by hand, ROS 2 bags by rosbags."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np


def write_ulog(path: Path, topics: Mapping[str, tuple[str, Sequence[tuple[Any, ...]]]]) -> None:
    """topics: by name, the fields as ULog writes them (`uint64_t timestamp;float output[2];`) and the rows, flat."""
    parts = [b"ULog\x01\x12\x35\x01", struct.pack("<Q", 0)]

    def add(kind: str, payload: bytes) -> None:
        parts.append(struct.pack("<HB", len(payload), ord(kind)) + payload)

    add("B", bytes(40))
    for name, (fields, _) in topics.items():
        add("F", f"{name}:{fields}".encode())
        if "esc_report[" in fields:
            add("F", b"esc_report:int32_t esc_rpm;float esc_voltage;")
        if "timed_report[" in fields:
            add("F", b"timed_report:uint64_t timestamp;int32_t esc_rpm;")
    for number, name in enumerate(topics):
        add("A", struct.pack("<BH", 0, number) + name.encode())
    for number, (fields, rows) in enumerate(topics.values()):
        for row in rows:
            add("D", struct.pack("<H", number) + struct.pack("<" + _codes(fields), *row))
    path.write_bytes(b"".join(parts))


def _codes(fields: str) -> str:
    codes = {"uint64_t": "Q", "float": "f", "int32_t": "i", "uint8_t": "B", "esc_report": "if", "timed_report": "Qi"}
    found = ""
    for field in filter(None, fields.split(";")):
        kind, _ = field.split()
        name, _, count = kind.partition("[")
        found += codes[name] * int(count.rstrip("]") or 1) if count else codes[name]
    return found


def write_rosbag(folder: Path, t_s: np.ndarray, command: np.ndarray, rpm: np.ndarray, *, mcap: bool) -> None:
    """`/fans/command` (Float64MultiArray, without times) and `/fans/state` (JointState, velocity in rad/s)."""
    from rosbags.rosbag2 import StoragePlugin, Writer  # noqa: PLC0415
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    stamp, header = types["builtin_interfaces/msg/Time"], types["std_msgs/msg/Header"]
    layout = types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    plugin = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        array, joints = "std_msgs/msg/Float64MultiArray", "sensor_msgs/msg/JointState"
        commands = writer.add_connection("/fans/command", array, typestore=store)
        states = writer.add_connection("/fans/state", joints, typestore=store)
        for row, t in enumerate(t_s):
            t_ns = round(t * 1e9)
            message = types[array](layout=layout, data=command[row])
            writer.write(commands, t_ns, store.serialize_cdr(message, array))
            state = types[joints](
                header=header(stamp=stamp(sec=t_ns // 10**9, nanosec=t_ns % 10**9), frame_id=""),
                name=["a", "b"],
                position=np.zeros(0),
                velocity=rpm[row] * 2 * np.pi / 60,
                effort=np.zeros(0),
            )
            writer.write(states, t_ns + 5_000_000, store.serialize_cdr(state, joints))


FLOAT64 = ("std_msgs/msg/Float64", "float64 data\n")
STAMPED = (
    "fans/msg/Stamped",
    "std_msgs/Header header\nfloat64 data\n"
    f"{'=' * 80}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    f"{'=' * 80}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n",
)
_CDR = b"\0\1\0\0"


def float64(value: float) -> bytes:
    """A message of FLOAT64."""
    return _CDR + struct.pack("<d", value)


def stamped(t_ns: int, value: float) -> bytes:
    """A message of STAMPED."""
    return _CDR + struct.pack("<iIIb3xd", *divmod(t_ns, 10**9), 1, 0, value)


def write_mcap(
    path: Path, topics: Mapping[str, tuple[tuple[str, str], Sequence[tuple[int, bytes]]]], *, encoding: str = "cdr"
) -> Path:
    """topics: by name, its type with its definition, and its messages, each with its time of receipt."""
    from mcap.writer import Writer  # noqa: PLC0415

    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1500)
        writer.start(profile="ros2", library="test")
        ids: dict[str, int] = {}
        for name, ((kind, text), _) in topics.items():
            schema = writer.register_schema(kind, "ros2msg", text.encode())
            ids[name] = writer.register_channel(name, encoding, schema)
        found = [(t_ns, ids[name], data) for name, (_, messages) in topics.items() for t_ns, data in messages]
        for t_ns, channel, data in sorted(found, key=lambda each: each[0]):
            writer.add_message(channel, t_ns, data, t_ns)
        writer.finish()
    return path


def write_bag_metadata(folder: Path, files: Sequence[str], counts: Mapping[str, int], qos: str = "") -> None:
    """metadata.yaml of a ROS 2 bag of FLOAT64 topics."""
    topics = "".join(
        f"  - topic_metadata: {{name: {name}, type: std_msgs/msg/Float64, serialization_format: cdr, "
        f'offered_qos_profiles: "{qos}"}}\n    message_count: {count}\n'
        for name, count in counts.items()
    )
    folder.joinpath("metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: mcap\n  topics_with_message_count:\n"
        f"{topics}  compression_format: ''\n  compression_mode: ''\n  relative_file_paths: [{', '.join(files)}]\n"
    )
