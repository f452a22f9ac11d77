"""A real MQTT broker (amqtt) in a thread of this process, which can be stopped and started again on its port."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Mapping
from typing import Any

from amqtt.broker import Broker

from tests.support.ports import free_port

ANONYMOUS = {"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}}


class MqttBroker:
    """A broker on loopback."""

    def __init__(self, plugins: Mapping[str, Any] = ANONYMOUS, **listener: Any) -> None:
        """listener: further settings of its listener, such as those of TLS."""
        self.port = free_port()
        bind = {"type": "tcp", "bind": f"127.0.0.1:{self.port}", **listener}
        self._config = {"listeners": {"default": bind}, "plugins": dict(plugins)}
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        self._broker: Broker | None = None

    def start(self) -> None:
        async def start() -> Broker:
            broker = Broker(self._config)
            await broker.start()
            return broker

        self._broker = self._run(start())

    def stop(self) -> None:
        if self._broker is not None:
            self._run(self._broker.shutdown())
            self._broker = None

    def close(self) -> None:
        self.stop()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(5)
        self._loop.close()

    def _run(self, work: Any) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(20)
