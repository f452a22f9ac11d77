"""`fantwin up --only` and `fantwin doctor` at a router that refuses, and what a stage alone says of its problems."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace

import pytest

from fantwin.pipeline.bus.rights import SiteRoles
from fantwin.pipeline.bus.router import open_router
from fantwin.pipeline.cli.watch import one_stage
from tests.support.fantwin_command import fantwin as called
from tests.support.secured_site import SITE, SecuredSite, free_endpoint


@pytest.fixture
def site(tmp_path) -> Iterator[SecuredSite]:
    made = SecuredSite(tmp_path, free_endpoint())
    made.config.path.write_text(made.config.text)
    yield made


def fewer_rights(site: SecuredSite) -> SiteRoles:
    """The resampler may not publish."""
    roles = dict(site.site.roles)
    return SiteRoles(SITE, {**roles, "resampler": replace(roles["resampler"], writes=())})


def test_whoever_may_not_command_is_told_the_role_that_may_in_words_of_the_documentation(site):
    site.certificates.show_as("operator", "viewer")
    source = "tray.0.source={kind = 'serial', port = '/dev/none'}"
    with site.running():
        done = called("command", "-c", site.config.path, "--tray", "a", "--fan", "0", "0.5", "--set", source)
    assert str(done.exception) == (
        "its certificate says 'viewer', which may not publish command of a; use the certificate of role 'operator'"
    )


def examined(site: SecuredSite) -> tuple[list[str], list[str]]:
    """The lines of doctor about certificates: good ones and problems."""
    done = called("doctor", "-c", site.config.path, "--listen-s", 0, "--json")
    found = json.loads(done.stdout)
    good, problems = ([line for line in found[kind] if "certificate" in line] for kind in ("good", "problems"))
    return good, problems


def test_doctor_says_of_each_certificate_whether_the_router_grants_its_rights(site):
    for role in ("twin_integrator", "scorer", "recorder"):
        (site.certificates.folder / f"{role}.pem").unlink()
    with open_router(site.endpoint, site.credentials("router"), site.site):
        good, problems = examined(site)
    assert "certificate of resampler: the router grants its rights" in good
    assert not [line for line in good if "scorer:" in line], "it is not here"
    assert problems == []
    with open_router(site.endpoint, site.credentials("router"), fewer_rights(site)):
        good, problems = examined(site)
    assert "certificate of viewer: the router grants its rights" in good
    assert problems == [
        "certificate of resampler: the router does not grant the rights of its role: restart the router with this "
        "configuration"
    ]


def test_doctor_without_a_router_says_until_when_certificates_hold_and_where_there_are_none(site):
    good, problems = examined(site)
    assert [line for line in good if line.startswith("certificate of resampler: until 2")]
    assert problems == []
    for path in site.certificates.folder.glob("*.pem"):
        path.unlink()
    assert examined(site)[1] == [
        f"{site.certificates.folder}: no certificate of any role here: `fantwin certs issue` makes them"
    ]


def test_a_stage_that_runs_alone_says_a_problem_once_and_that_it_is_resolved(monkeypatch):
    lines: list[str] = []
    monkeypatch.setattr(one_stage, "_say", lines.append)
    problems = one_stage.Problems("recorder")
    for problem in ("", "12.3 MB are free", "11.9 MB are free", "", ""):
        problems.report(problem)
    assert lines == ["recorder: 12.3 MB are free", "recorder: the problem is resolved"]
