"""A process on the bus that sends the messages of trays of fans at 100 Hz, and counts what it has sent.

Words: ENDPOINT TRAYS FANS HISTORY FILE. Each tray has raw, grid, prediction and score messages of one sample. It keeps
the last HISTORY messages of each for consumers that missed them. While no recorder is ready it sends MOST_WITHOUT
samples at most, however long a busy machine takes to start one. When its standard input closes it ends like a stage,
and writes to FILE, for each key, at which time (ns since 1970) each message was sent: the place is the sequence number.
Then it answers for what it keeps until it is killed.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import BusConfig
from fantwin.schemas.codec import encode, type_name
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.header import Header
from fantwin.schemas.health import Health, Output
from fantwin.schemas.messages import Grid, Message, Prediction, Raw, Score
from fantwin.schemas.topics import BY_NAME, alive_key, health_key, tray_key

SITE, PRODUCER, STAGE = "kills", "feed-1", "feed"
HEALTH_PERIOD_S = 1.0
STEP_S = 0.01
MOST_WITHOUT = 400
"""samples that are sent while no recorder is ready"""
TOPICS = ("raw", "grid", "prediction", "score")


def messages(fans: int, number: int) -> dict[str, Message]:
    """One sample of a tray, that does not compress."""
    speed = np.random.default_rng(number).normal(100.0, 3.0, (1, fans))
    t_ns, ones, zeros = np.array([time.time_ns()]), np.ones((1, fans), np.bool_), np.zeros((1, fans), np.uint8)
    common: dict[str, Any] = {"fans": fans, "period_ns": 10_000_000, "t_ns": t_ns, "command": np.full((1, fans), 0.6)}
    judged: dict[str, Any] = {**common, "valid": ones, "invalid_reason": zeros, "measured_speed_rad_s": speed}
    return {
        "raw": Raw(fans=fans, host_receive_t_ns=t_ns, command=common["command"], speed_rad_s=speed),
        "grid": Grid(**common, speed_rad_s=speed, valid=ones, invalid_reason=zeros),
        "prediction": Prediction(
            **judged,
            predicted_speed_rad_s=speed * 1.01,
            sigma_rad_s=np.full(fans, 3.0),
            torque_balance_command=speed * 1e-4,
            torque_balance_sigma_command=np.full(fans, 0.01),
        ),
        "score": Score(
            **judged,
            predicted_speed_rad_s=speed * 1.01,
            band_variance=np.full((1, fans), 36.0),
            state=zeros + 1,
            torque_balance_command=speed * 1e-4,
            expected_residual_rad_s=speed * 0.0,
            expected_balance_command=speed * 0.0,
            score=speed * 1e-3,
            statistic=zeros + 1,
        ),
    }


def main(endpoint: str, trays: int, fans: int, history: int, file: Path) -> None:
    stop = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), stop.set()), daemon=True).start()
    sent_ns: dict[str, list[int]] = {}
    with Bus(BusConfig(endpoint=endpoint)) as bus:
        publishers = {}
        for tray in (f"tray{number + 1}" for number in range(trays)):
            for name in TOPICS:
                topic = replace(BY_NAME[name], history=history)
                key = tray_key(SITE, tray, name)
                publishers[tray, name] = bus.publisher(key, topic, type_name(topic.message), PRODUCER)
                sent_ns[key] = []
        recorders: set[str] = set()

        def note_recorder(key: str, alive: bool) -> None:
            if alive:
                recorders.add(key)
            else:
                recorders.discard(key)

        bus.watch_alive(alive_key(SITE, "recorder", "*"), note_recorder)
        health_publisher = bus.publisher(health_key(SITE, STAGE, "all"), BY_NAME["health"], type_name(Health), PRODUCER)
        bus.declare_alive(alive_key(SITE, STAGE, "all"))

        def put_health(status: StageStatus) -> None:
            health = Health(
                header=Header(PRODUCER, health_publisher.published, ""),
                stage=STAGE,
                instance="all",
                status=status,
                t_ns=time.time_ns(),
                uptime_s=0.0,
                outputs=tuple(
                    Output(key=publisher.key, published=publisher.published) for publisher in publishers.values()
                ),
            )
            health_publisher.put(encode(health))

        print("feeding", flush=True)
        number = without = 0
        next_s = health_s = time.monotonic()
        while not stop.wait(max(0.0, next_s - time.monotonic())):
            if number and time.monotonic() >= health_s:  # not before the first message: earlier ones are history
                health_s = time.monotonic() + HEALTH_PERIOD_S
                put_health(StageStatus.OK)
            without = 0 if recorders else without + 1
            if without > MOST_WITHOUT:
                next_s = time.monotonic() + STEP_S
                continue
            next_s += STEP_S
            made = messages(fans, number)
            for (tray, name), publisher in publishers.items():
                stamped = replace(made[name], header=Header(PRODUCER, publisher.published, tray))
                sent_ns[publisher.key].append(time.time_ns())
                publisher.put(encode(stamped))
            number += 1
        put_health(StageStatus.STOPPED)
        file.write_text(json.dumps(sent_ns))
        print("fed", flush=True)
        threading.Event().wait()


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]), Path(sys.argv[5]))
