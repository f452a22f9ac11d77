"""`fantwin deploy` writes what an installed fantwin brings with it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.support.fantwin_command import error_of, fantwin


@pytest.mark.parametrize(
    ("target", "some"),
    [
        ("systemd", ["etc/systemd/system/fantwin.service", "etc/systemd/system/fantwin-router.service"]),
        ("compose", ["compose.yaml", "Dockerfile", "requirements.lock", "site/twin.onnx", "prometheus/prometheus.yml"]),
        ("helm", ["Chart.yaml", "templates/stages.yaml"]),
        ("grafana", ["fantwin.json", "prometheus.yml", "fantwin.rules.yml"]),
    ],
)
def test_each_target_is_a_new_folder_of_files_without_links(tmp_path: Path, target: str, some: list[str]) -> None:
    out = tmp_path / "out"
    done = fantwin("deploy", target, "-o", out, "--json")
    assert done.exit_code == 0, done.exception
    found = json.loads(done.stdout)
    assert {str(out / name) for name in some} <= set(found["files"]) and str(out) in found["next"]
    assert not [path for path in out.rglob("*") if path.is_symlink()]
    assert error_of("deploy", target, "-o", out) == f"{out}: exists; name a new folder with -o"


def test_compose_says_which_configuration_is_used_and_that_the_one_here_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    site = "the site is a simulated tray, by {}/site/fantwin.toml{}: put your [[tray]] there"
    assert site.format("one", "") in fantwin("deploy", "compose", "-o", "one").stdout
    (tmp_path / "fantwin.toml").touch()
    assert site.format("two", " and not by fantwin.toml") in fantwin("deploy", "compose", "-o", "two").stdout
