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
        if name == "esc_status":
            add("F", b"esc_report:int32_t esc_rpm;float esc_voltage;")
    for number, name in enumerate(topics):
        add("A", struct.pack("<BH", 0, number) + name.encode())
    for number, (fields, rows) in enumerate(topics.values()):
        for row in rows:
            add("D", struct.pack("<H", number) + struct.pack("<" + _codes(fields), *row))
    path.write_bytes(b"".join(parts))


def _codes(fields: str) -> str:
    codes = {"uint64_t": "Q", "float": "f", "int32_t": "i", "esc_report": "if"}
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
