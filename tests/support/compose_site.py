"""The site of `fantwin deploy compose` in containers, for tests inside `tests/deploy/compose/in_namespaces.sh`."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import yaml

from tests.support.built_wheel import copied_source, wheel_of
from tests.support.fantwin_command import fantwin as fantwin_here

PROJECT = "fantwin"
NETWORK = f"{PROJECT}_bus"
BASE_IMAGE = "docker.io/library/python:3.11-slim-bookworm"
CONFIG = "/site/fantwin.toml"
AT_WORK = ("ok", "waiting")
_POLL_S = 0.1

Status = dict[str, Any]


def folder() -> Path | None:
    """Where images, wheels and volumes are; None outside the namespaces."""
    given = os.environ.get("FANTWIN_CONTAINERS")
    return Path(given) if given else None


def deployed() -> Path:
    """The folder that `fantwin deploy compose` has written, with the wheel."""
    inside = folder()
    assert inside is not None
    return inside / "deployed"


def run(*words: str, timeout_s: float = 60.0, **environment: str) -> subprocess.CompletedProcess[str]:
    """A command in the folder of compose.yaml; whether it has succeeded is for the caller to see."""
    return subprocess.run(
        words,
        cwd=deployed(),
        env=os.environ | environment,
        text=True,
        capture_output=True,
        timeout=timeout_s,
        check=False,
    )


def succeed(*words: str, timeout_s: float = 60.0, **environment: str) -> str:
    """What a command prints that must succeed."""
    done = run(*words, timeout_s=timeout_s, **environment)
    assert done.returncode == 0, f"{' '.join(words)}: {done.returncode}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
    return done.stdout


def compose(*words: str, **environment: str) -> str:
    """`podman-compose` with the product's own file."""
    return succeed("podman-compose", "--in-pod", "false", "-p", PROJECT, *words, timeout_s=120.0, **environment)


def container(service: str) -> str:
    """The name of a service's container."""
    return f"{PROJECT}_{service}_1"


def build(wheels: Path, pip_settings: Path, base: Path) -> None:
    """The site as a user would deploy it, and its image, from wheels alone: no network."""
    shutil.rmtree(deployed(), ignore_errors=True)
    assert fantwin_here("deploy", "compose", "-o", deployed()).exit_code == 0
    with TemporaryDirectory() as source:
        wheel_of(copied_source(Path(source)), deployed())
    if run("podman", "image", "exists", BASE_IMAGE).returncode:
        succeed("podman", "import", str(base), BASE_IMAGE)
    mounts = ("-v", f"{wheels}:/wheels:ro", "-v", f"{pip_settings}:/etc/pip.conf:ro")
    alone = ("--format", "docker", "--pull=never", "--network=none")  # the form of OCI has no health check
    succeed("podman", "build", "-q", *alone, *mounts, "-t", "fantwin", ".", timeout_s=600.0)
    succeed("podman", "image", "prune", "-f")


def prometheus_from(program: str | None) -> None:
    """A stand-in for the image of Prometheus that compose.yaml names, with this machine's program."""
    assert program
    image = yaml.safe_load((deployed() / "compose.yaml").read_text())["services"]["prometheus"]["image"]
    context = deployed() / "stand-in"
    context.mkdir(exist_ok=True)
    shutil.copy(program, context / "prometheus")
    lines = f'FROM {BASE_IMAGE}\nCOPY prometheus /bin/\nRUN mkdir /prometheus\nENTRYPOINT ["/bin/prometheus"]\n'
    (context / "Dockerfile").write_text(lines)
    succeed("podman", "build", "-q", "--pull=never", "--network=none", "-t", image, str(context))


def process_id(service: str) -> int:
    """The first process of a service; 0 while it does not run."""
    found = run("podman", "inspect", "-f", "{{.State.Pid}}", container(service))
    return int(found.stdout) if found.returncode == 0 else 0


def kill(service: str) -> None:
    """Kill the process as the kernel would, and wait until another one runs in its place."""
    before = process_id(service)
    os.kill(before, signal.SIGKILL)
    wait_until(lambda: process_id(service) not in (0, before), 15.0, f"{service} is not restarted")


def cut_off(service: str, seconds: float) -> None:
    """Take a service off the network and put it back, perhaps at another address."""
    succeed("podman", "network", "disconnect", NETWORK, container(service))
    time.sleep(seconds)
    succeed("podman", "network", "connect", NETWORK, container(service))


def fantwin(*words: str) -> subprocess.CompletedProcess[str]:
    """A command in the container of the gateway, which has the certificate of the gateway only."""
    return run("podman", "exec", container("gateway"), "fantwin", *words)


def status() -> Status:
    """What `fantwin status` says inside a container; empty while it has no answer."""
    answer = fantwin("status", "-c", CONFIG, "--json")
    return json.loads(answer.stdout) if answer.stdout.startswith("{") else {"error": answer.stderr}


def in_new_container(script: str) -> subprocess.CompletedProcess[str]:
    """A script in a container of its own, on the network of the site, without its volumes."""
    shell = ("--entrypoint", '["sh", "-euc"]', "fantwin", script)
    return run("podman", "run", "--rm", "--network", NETWORK, *shell)


def is_well(seen: Status) -> bool:
    """Every stage is at work and every fan is judged."""
    stages = seen.get("stages", [])
    return bool(stages) and all(each["state"] in AT_WORK for each in stages) and not seen["not_judged"]


def well_again(within_s: float, is_so: Callable[[Status], bool] = lambda _: True) -> tuple[Status, float]:
    """The status once all is well and `is_so`, and after how many seconds."""
    began_s = time.monotonic()
    seen: Status = {}

    def look() -> bool:
        nonlocal seen
        seen = status()
        return is_well(seen) and is_so(seen)

    wait_until(look, within_s, lambda: f"not well: {seen}")
    return seen, time.monotonic() - began_s


def wait_until(is_so: Callable[[], bool], within_s: float, otherwise: str | Callable[[], str]) -> None:
    until_s = time.monotonic() + within_s
    while not is_so():
        assert time.monotonic() < until_s, otherwise if isinstance(otherwise, str) else otherwise()
        time.sleep(_POLL_S)


def losses(seen: Status) -> dict[str, int]:
    """What each stage says it has lost, without zeros."""
    return {each["stage"]: each["lost"] for each in seen["stages"] if each.get("lost")}
