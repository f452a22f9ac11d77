"""Debian's Prometheus in a process on loopback: it scrapes a gateway as `deploy/` says, but more often."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import urllib.error
import urllib.parse
import urllib.request
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.support.ports import free_port
from tests.support.running_chain import eventually

DEPLOY = Path(__file__).parents[2] / "deploy"
INTERVAL = "500ms"

needs_prometheus = pytest.mark.skipif(
    shutil.which("prometheus") is None or shutil.which("promtool") is None, reason="prometheus is not installed"
)


class RunningPrometheus:
    """target: port of the gateway that it scrapes."""

    def __init__(self, folder: Path, target: int) -> None:
        configuration = yaml.safe_load((DEPLOY / "prometheus" / "prometheus.yml").read_text())
        configuration["global"] = {"scrape_interval": INTERVAL, "scrape_timeout": INTERVAL, "evaluation_interval": "1s"}
        (scraped,) = configuration["scrape_configs"]
        scraped["static_configs"][0]["targets"] = [f"127.0.0.1:{target}"]
        for name in configuration["rule_files"]:
            shutil.copy(DEPLOY / "prometheus" / name, folder)
        path = folder / "prometheus.yml"
        path.write_text(yaml.safe_dump(configuration))
        self.port = free_port()
        self._process = subprocess.Popen(
            [
                *("prometheus", f"--config.file={path}", f"--storage.tsdb.path={folder / 'data'}"),
                *(f"--web.listen-address=127.0.0.1:{self.port}", "--log.level=warn"),
            ],
            stderr=(folder / "log").open("wb"),
        )
        eventually(self._is_ready, "Prometheus is ready")

    def query(self, expression: str) -> list[tuple[dict[str, str], float]]:
        """Labels and values now; without those that are not a number."""
        found = self.ask("query", query=expression)
        assert found["resultType"] == "vector", expression
        values = [(each["metric"], float(each["value"][1])) for each in found["result"]]
        return [(labels, value) for labels, value in values if not math.isnan(value)]

    def value(self, expression: str) -> float | None:
        """The only value now; None: there is none."""
        found = self.query(expression)
        assert len(found) <= 1, (expression, found)
        return found[0][1] if found else None

    def alert_states(self) -> dict[str, str]:
        """States of alerts by name: inactive, pending or firing. Every rule must have been evaluated without error."""
        rules = [rule for group in self.ask("rules")["groups"] for rule in group["rules"]]
        assert all(not rule.get("lastError") for rule in rules), rules
        return {rule["name"]: rule["state"] for rule in rules if rule["type"] == "alerting" and rule["health"] == "ok"}

    def ask(self, path: str, **parameters: str) -> Any:
        """What its API answers."""
        url = f"http://127.0.0.1:{self.port}/api/v1/{path}?{urllib.parse.urlencode(parameters)}"
        try:
            with urllib.request.urlopen(url, timeout=20) as answer:
                return json.load(answer)["data"]
        except urllib.error.HTTPError as error:
            raise AssertionError(f"{parameters}: {error.read().decode()}") from error

    def close(self) -> None:
        self._process.kill()
        self._process.wait()

    def _is_ready(self) -> bool:
        assert self._process.poll() is None, "Prometheus has ended"
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{self.port}/-/ready", timeout=20) as answer:
                return answer.status == 200
        except OSError:
            return False
