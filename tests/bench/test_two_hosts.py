"""bench.fleet.two_hosts: the shards of a host that vanishes go on elsewhere, and nothing is lost or forgotten."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from bench.fleet.network_hosts import ALONE

pytestmark = [pytest.mark.slow, pytest.mark.real_time]


def test_the_shards_of_a_host_that_vanishes_go_on_on_the_other_one():
    try:
        subprocess.run([*ALONE, "ip", "link"], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no network namespace can be made here")
    words = [sys.executable, "-m", "bench.fleet.two_hosts", "--seconds", "40", "--json"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    (found,) = json.loads(done.stdout)["two hosts"]
    assert found["alarms"] == 16
    assert [found[name] for name in ("not recorded", "not scored", "forgotten", "too many", "raised again")] == [0] * 5
