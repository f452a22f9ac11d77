"""Debian's MQTT broker in a process, which can be stopped, killed and started again on its port."""

from __future__ import annotations

import shutil
import signal
import socket
import subprocess
import threading
from pathlib import Path
from typing import Any

import paho.mqtt.client as paho
import pytest
from paho.mqtt.enums import CallbackAPIVersion

from tests.support.ports import free_port
from tests.support.running_chain import DEADLINE_S, eventually

needs_mosquitto = pytest.mark.skipif(shutil.which("mosquitto") is None, reason="mosquitto is not installed")


class Mosquitto:
    """A broker on loopback that forgets everything when it stops. lines: of its configuration."""

    def __init__(self, folder: Path, *lines: str) -> None:
        self.port = free_port()
        self._configuration = folder / "mosquitto.conf"
        rest = lines or ("allow_anonymous true",)
        self._configuration.write_text("\n".join((f"listener {self.port} 127.0.0.1", "user root", *rest)) + "\n")
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        self._process = subprocess.Popen(["mosquitto", "-c", self._configuration], stderr=subprocess.DEVNULL)
        eventually(self._answers, "the broker listens")

    def stop(self) -> None:
        if self._process is not None:
            self._process.send_signal(signal.SIGCONT)
            self._process.kill()
            self._process.wait()
            self._process = None

    def hang(self) -> None:
        """It keeps its connections, and does nothing, until it is stopped or goes on."""
        assert self._process
        self._process.send_signal(signal.SIGSTOP)

    def go_on(self) -> None:
        assert self._process
        self._process.send_signal(signal.SIGCONT)

    def _answers(self) -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", self.port)) == 0


class Listener:
    """A client that hears everything."""

    def __init__(self, port: int) -> None:
        self.heard: list[tuple[str, str, bool]] = []
        """topic, text and whether the broker had kept it"""
        self._subscribed = threading.Event()
        client = self.client = paho.Client(CallbackAPIVersion.VERSION2)
        client.on_connect = self._on_connect
        client.on_subscribe = lambda *_rest: self._subscribed.set()
        client.on_message = self._on_message
        client.connect("127.0.0.1", port)
        client.loop_start()
        assert self._subscribed.wait(DEADLINE_S)

    def _on_connect(self, client: paho.Client, *_rest: Any) -> None:
        client.subscribe("#", 0)

    def _on_message(self, _client: Any, _data: Any, message: paho.MQTTMessage) -> None:
        self.heard.append((message.topic, message.payload.decode(), message.retain))

    def of(self, topic: str) -> list[str]:
        """All texts of a topic."""
        return [text for heard, text, _ in self.heard if heard == topic]

    def last(self, topic: str) -> str | None:
        """The last text of a topic; None: there was none."""
        texts = self.of(topic)
        return texts[-1] if texts else None

    def publish(self, topic: str, text: str, *, retain: bool = False) -> None:
        self.client.publish(topic, text, 1, retain).wait_for_publish(20)

    def close(self) -> None:
        self.client.disconnect()
        self.client.loop_stop()


def retained_by(port: int) -> dict[str, str]:
    """What the broker keeps."""
    listener = Listener(port)
    listener.publish("tests/end", "")
    eventually(lambda: listener.of("tests/end"), "all that is kept has come")
    listener.close()
    return {topic: text for topic, text, is_retained in listener.heard if is_retained}
