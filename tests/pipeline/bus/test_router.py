"""`fantwin router`: sessions on several hosts communicate through it."""

from __future__ import annotations

import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import pytest

from fantwin.pipeline.bus.errors import BusError
from fantwin.pipeline.bus.router import open_router
from fantwin.pipeline.bus.session import Bus, join_bus
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.config.settings import BusConfig
from fantwin.schemas.topics import BY_NAME, tray_key
from tests.support.fantwin_command import error_of
from tests.support.running_chain import DEMO, RunningCommand, eventually

KEY = tray_key("site", "tray", "alarm")


@pytest.fixture
def started() -> Iterator[list[RunningCommand]]:
    processes: list[RunningCommand] = []
    yield processes
    for process in processes:
        process.kill()


def client(endpoint: str, stop: threading.Event | None = None) -> Bus:
    return Bus(BusConfig(mode="client", endpoint=endpoint), stop)


def exchange(listener: Bus, speaker: Bus) -> bytes:
    """The payload that `listener` receives from `speaker`, published repeatedly until discovery has connected them."""
    heard: queue.Queue[bytes] = queue.Queue()
    listener.subscribe(KEY, lambda _key, payload: heard.put(payload))
    publisher = speaker.publisher(KEY, BY_NAME["alarm"], "x", "speaker")
    for _ in range(600):
        publisher.put(b"hello")
        try:
            return heard.get(timeout=0.1)
        except queue.Empty:
            continue
    raise AssertionError("nothing was heard in a minute")


def test_a_client_that_waits_for_its_router_says_so(endpoint, monkeypatch):
    monkeypatch.setattr("fantwin.pipeline.bus.session.SAID_AFTER_S", 0.0)
    said: queue.Queue[str] = queue.Queue()
    stop = threading.Event()

    def say(line: str) -> None:
        said.put(line)
        stop.set()

    config = load_config(DEMO / "demo.toml", ["bus.mode='client'", f"bus.endpoint='{endpoint}'"], stages=())
    with pytest.raises(BusError, match="no router answers"):
        join_bus(config, stop, say=say)
    assert said.get_nowait() == f"waiting for a router at {endpoint}: start `fantwin router`"


def test_clients_that_start_before_the_router_connect_once_it_runs(endpoint):
    config, never = BusConfig(mode="client", endpoint=endpoint), threading.Event()
    with ThreadPoolExecutor() as pool, ExitStack() as running:
        try:
            waiting = [pool.submit(Bus, config, never) for _ in range(2)]
            with pytest.raises(BusError, match="no router answers"):
                client(endpoint)  # there is none yet, and this one does not wait
            assert not any(bus.done() for bus in waiting)
            running.enter_context(open_router(endpoint))
            one, other = (running.enter_context(bus.result(timeout=60)) for bus in waiting)
        finally:
            never.set()
        assert exchange(one, other) == b"hello"


@pytest.mark.parametrize(
    "words",
    [
        *("status --once", "status --wear", "alarms", "alarms acknowledge tray1 0 --timeout 1"),
        *("command --fan 0 0.5", "command --sweep"),
    ],
)
def test_a_question_to_a_site_whose_router_is_down_is_answered_soon(words, endpoint):
    settings = ("--set", "bus.mode='client'", "--set", f"bus.endpoint='{endpoint}'")
    assert "no router answers" in error_of(*words.split(), "-c", DEMO / "demo.toml", *settings)


def test_waiting_for_a_router_ends_on_stop(endpoint, started):
    """Waiting in another process, which must not be deaf to a signal."""
    words = ["up", "--only", "scorer", "-c", DEMO / "demo.toml", "--set", "bus.mode=client", "--set"]
    stage = RunningCommand([*words, f"bus.endpoint={endpoint}"])
    started.append(stage)
    eventually(lambda: catches_interrupts(stage.process.pid), "it handles Ctrl-C")
    assert stage.end() == 1
    assert "no router answers" in stage.line_with("fantwin:")


def catches_interrupts(process_id: int) -> bool:
    status = Path(f"/proc/{process_id}/status").read_text()
    caught = int(status.split("SigCgt:")[1].split()[0], 16)
    return bool(caught >> (signal.SIGTERM - 1) & 1)  # Python itself catches SIGINT from the first


LISTENS = """
import sys, threading
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import BusConfig
bus = Bus(BusConfig(mode="client", endpoint=sys.argv[1]), threading.Event())
bus.subscribe(sys.argv[2], lambda _key, payload: print("heard", flush=True))
sys.stdin.read()
"""


def test_a_client_that_takes_nothing_any_more_does_not_cut_the_others_off(endpoint, started):
    """The router waits for it at most a second, well below the lease of the client that sends."""
    router = RunningCommand(["router", "--listen", endpoint, "--json"])
    started.append(router)
    heard: queue.Queue[bytes] = queue.Queue()
    with client(endpoint, threading.Event()) as one, client(endpoint) as other:
        exchange(one, other)
        words = [sys.executable, "-c", LISTENS, endpoint, KEY]
        with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as silent:
            assert silent.stdout
            publisher = other.publisher(KEY, BY_NAME["alarm"], "x", "speaker-2")
            heard_there = threading.Thread(target=silent.stdout.readline)
            heard_there.start()

            def has_heard() -> bool:
                publisher.put(b"hello")
                return not heard_there.is_alive()

            eventually(has_heard, "it hears")
            silent.send_signal(signal.SIGSTOP)
            one.subscribe(KEY, lambda _key, payload: None if payload == b"hello" else heard.put(payload))
            numbers = [f"{number}".encode().ljust(50_000) for number in range(600)]
            for number in numbers:
                publisher.put(number)
            taken = [heard.get(timeout=20) for _ in numbers]
            silent.kill()
    assert taken == numbers
    assert router.end() == 0
    assert router.output() == {"listening": endpoint}


def test_a_second_router_at_the_same_place_is_refused_in_one_line(endpoint):
    with open_router(endpoint):
        assert "is one running already?" in error_of("router", "--listen", endpoint)


def test_a_router_takes_settings_of_zenoh(endpoint):
    """Settings as docs/how-to/security.md has them: no message of this topic is longer than 1000 bytes."""
    rule = {"flows": ["ingress"], "messages": ["put"], "key_exprs": [KEY], "size_limit": 1000}
    received: queue.Queue[bytes] = queue.Queue()
    settings = {"low_pass_filter": [rule]}
    with open_router(endpoint, zenoh_settings=settings), client(endpoint) as one, client(endpoint) as other:
        exchange(one, other)
        one.subscribe(KEY, lambda _key, payload: received.put(payload))
        publisher = other.publisher(KEY, BY_NAME["alarm"], "x", "speaker-2")

        def next_length() -> int:
            publisher.put(bytes(2000))
            publisher.put(bytes(1000))
            return len(received.get(timeout=20))

        assert {next_length() for _ in range(3)} == {1000}


def test_without_c_the_configuration_in_this_folder_holds(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ("router", "--listen", "tls/0.0.0.0:7447")
    assert "write a section [bus.security]" in error_of(*words)
    assert "there is no fantwin.toml here" in error_of(*words, "--set", "site='b'")
    Path("fantwin.toml").write_text('[bus]\nmode = "client"\n[bus.security]\n[[tray]]\nname = "a"\nfans = 1\n')
    missing = error_of(*words)
    assert "router.pem" in missing and "fantwin certs issue" in missing
