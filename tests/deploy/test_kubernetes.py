"""The chart, rendered by Helm's own library and checked against the schemas of Kubernetes; nothing is installed."""

from __future__ import annotations

import json
import os
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest

from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.config.registry import STAGES
from tests.support.fantwin_words import parsed

why = "the chart is not checked: pip install helm-python-sdk kubernetes-validate"
helm: Any = pytest.importorskip("helm_python", reason=why)
schemas: Any = pytest.importorskip("kubernetes_validate", reason=why)
yaml: Any = pytest.importorskip("yaml", reason=why)

DEPLOY = Path(__file__).parents[2] / "deploy"
CHART = DEPLOY / "kubernetes" / "fantwin"
CONFIGURATION = 'site = "plant"\n[[tray]]\nname = "a"\nfans = 8\n'
OLDEST, NEWEST = "1.28", "1.37"
"""versions of Kubernetes: the first of which schemas have the fields that the chart needs, and the newest known"""
SECURED = {"config": CONFIGURATION, "certificates": {"secret": "plant-certs"}}
ONE_PAGE = {"stages": {"gateway": {"shards": 1, "storage": "1Gi"}}}
INGRESS = {"enabled": True, "className": "nginx", "host": "fans.example", "tlsSecret": "tls", "annotations": {"a": "b"}}
WATCHED = {
    **ONE_PAGE,
    "page": {"ingress": INGRESS},
    "metrics": {
        "labels": {"release": "prometheus"},
        "serviceMonitor": {"enabled": True, "userSecret": "scraper"},
        "rules": {"enabled": True},
        "dashboards": {"enabled": True},
    },
    "serviceAccount": {"create": True, "name": "fans"},
    "tolerations": [{"key": "plant", "operator": "Exists"}],
    "nodeSelector": {"disk": "fast"},
    "storageClassName": "ssd",
}
OPEN = {"certificates": {"secret": ""}, "insecure": True}
MANY = {stage: {"shards": 3, "storage": "1Gi" if stage in ("recorder", "learner") else ""} for stage in STAGES}


def files(name: str = "plant", **values: Any) -> dict[str, str]:
    with helm.Chart.load(str(CHART)) as chart:
        return chart.render({**SECURED, **values}, name=name, namespace="fans")


def rendered(name: str = "plant", **values: Any) -> list[dict[str, Any]]:
    texts = [text for path, text in files(name, **values).items() if not path.endswith("NOTES.txt")]
    return [document for text in texts for document in yaml.safe_load_all(text) if document]


def of_kind(kind: str, documents: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    return {each["metadata"]["name"]: each for each in documents if each["kind"] == kind}


@pytest.fixture(scope="module")
def stages() -> dict[str, dict[str, Any]]:
    """The stateful sets of a site where every stage has three shards, by stage."""
    sets = of_kind("StatefulSet", rendered(stages=MANY))
    return {each["spec"]["selector"]["matchLabels"]["app.kubernetes.io/component"]: each for each in sets.values()}


def container(stateful_set: dict[str, Any]) -> dict[str, Any]:
    (found,) = stateful_set["spec"]["template"]["spec"]["containers"]
    return found


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"stages": MANY, "files": {"configMap": {"name": "twins"}}, "image": {"pullSecrets": [{"name": "registry"}]}},
        OPEN,
        WATCHED,
    ],
    ids=str,
)
def test_what_is_rendered_fits_the_schemas_of_kubernetes(values):
    documents = rendered(**values)
    assert {"ConfigMap", "Service", "StatefulSet"} <= {each["kind"] for each in documents}
    for document in documents:
        if document["apiVersion"].startswith("monitoring.coreos.com/"):
            continue  # of the Prometheus operator, whose schemas are not those of Kubernetes
        for version in (OLDEST, NEWEST):
            schemas.validate(document, version, strict=True)


@pytest.mark.parametrize(
    "values",
    [
        {"stages": {"scorer": {"shards": 1, "storage": "much"}}},
        {"image": {"pullSecrets": ["registry"]}},
        {"stage": {}},
        {"config": ""},
        {"page": {"ingress": {"enabled": True, "host": "fans.example", "tlsSecret": "tls"}}},
        {**ONE_PAGE, "page": {"ingress": {"enabled": True, "host": "fans.example"}}},
        {"page": {"port": "http"}},
        {"certificates": {"secret": ""}},
    ],
    ids=str,
)
def test_wrong_values_are_refused(values):
    with pytest.raises(helm.HelmError):
        rendered(**values)


def test_another_number_of_shards_is_another_set_with_pods_and_a_service_of_its_own_and_without_shards_there_is_none():
    assert set(of_kind("StatefulSet", rendered(stages={"scorer": {"shards": 0}}))) == {
        f"plant-{stage}-of-1" for stage in ("resampler", "twin-integrator", "recorder")
    }
    for shards in (2, 3):
        (of_scorer,) = (
            each
            for name, each in of_kind("StatefulSet", rendered(stages={"scorer": {"shards": shards}})).items()
            if "scorer" in name
        )
        assert of_scorer["metadata"]["name"] == of_scorer["spec"]["serviceName"] == f"plant-scorer-of-{shards}"
    long = "a-release-whose-name-is-as-long-as-helm-allows-53-cha"
    names = of_kind("StatefulSet", rendered(long, stages={"scorer": {"shards": 4096}}))
    assert all(re.fullmatch(r"[a-z0-9]([a-z0-9-]*[a-z0-9])?", name) for name in names)
    assert max(map(len, names)) <= 52, "the hash of the revision is appended to it in a label of 63 characters"


def test_the_pods_of_a_stage_share_the_trays_and_keep_what_must_survive_them(stages):
    assert list(yaml.safe_load((CHART / "values.yaml").read_text())["stages"]) == list(STAGES)
    assert stages.keys() == STAGES.keys()
    for stage, stateful_set in stages.items():
        spec, pod = stateful_set["spec"], container(stateful_set)
        assert (spec["replicas"], spec["ordinals"]) == (3, {"start": 1})
        (ordinal,) = (each for each in pod["env"] if each["name"] == "SHARD")
        assert ordinal["valueFrom"]["fieldRef"]["fieldPath"] == "metadata.labels['apps.kubernetes.io/pod-index']"
        for number in (1, 3):
            found = parsed([word.replace("$(SHARD)", str(number)) for word in pod["args"]])
            assert (found["only"], found["shard"]) == (stage, f"{number}/3")
            assert {"bus.mode=client", "bus.endpoint=tls/plant-router:7447"} <= set(found["overrides"])
        claims = [each["metadata"]["name"] for each in spec.get("volumeClaimTemplates", ())]
        volumes = [each["name"] for each in spec["template"]["spec"]["volumes"]]
        is_kept = bool(MANY[stage]["storage"])
        assert (claims, "run" in volumes) == ((["run"], False) if is_kept else ([], True)), stage


def test_a_pod_is_ready_when_its_own_process_is_at_work_and_alive_while_its_main_loop_renews_its_file(stages, tmp_path):
    program = tmp_path / "fantwin"
    program.write_text('#!/bin/sh\nprintf "%s\\n" "$@"\n')
    program.chmod(0o755)
    environment = {"PATH": f"{tmp_path}:{os.environ['PATH']}", "SHARD": "2"}
    for stage in ("scorer", "twin_integrator"):
        command = container(stages[stage])["readinessProbe"]["exec"]["command"]
        done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
        found = parsed(done.stdout.splitlines())
        assert (found["stage"], found["shard"]) == (stage, "2/3")
    file = tmp_path / "alive"
    env = {each["name"]: each.get("value") for each in container(stages["scorer"])["env"]}
    assert env["FANTWIN_ALIVE_FILE"] == "/tmp/alive"
    *shell, script = container(stages["scorer"])["livenessProbe"]["exec"]["command"]

    def is_alive() -> bool:
        return not subprocess.run([*shell, script.replace("/tmp/alive", str(file))], check=False).returncode

    assert not is_alive()
    file.touch()
    assert is_alive()
    os.utime(file, (0, 0))
    assert not is_alive()


def test_a_pod_has_the_certificate_of_its_own_role_only_and_only_pods_of_the_site_reach_their_router(stages):
    documents = rendered()
    (policy,) = of_kind("NetworkPolicy", documents).values()
    (peer,) = policy["spec"]["ingress"][0]["from"]
    assert peer["podSelector"]["matchLabels"]["app.kubernetes.io/instance"] == "plant"
    (router,) = of_kind("Deployment", documents).values()
    for role, pods in {**stages, "router": router}.items():
        (volume,) = (each for each in pods["spec"]["template"]["spec"]["volumes"] if each["name"] == "certificates")
        files = {each["path"] for each in volume["secret"]["items"]}
        assert (volume["secret"]["secretName"], files) == ("plant-certs", {"ca.pem", f"{role}.pem", f"{role}.key"})
        words = container(pods)["args"]
        settings = parse_config(CONFIGURATION, Path("fantwin.toml"), parsed(words)["overrides"], stages=())
        security = settings.bus.security
        assert security
        wanted = (security.ca, security.certificate(role), security.key(role))
        assert {str(path) for path in wanted} == {f"/etc/fantwin/certs/{name}" for name in files}
    assert "--listen=tls/0.0.0.0:7447" in container(router)["args"]


def test_without_certificates_every_command_says_that_it_is_insecure():
    documents = rendered(**OPEN)
    for pods in (*of_kind("StatefulSet", documents).values(), *of_kind("Deployment", documents).values()):
        words = container(pods)["args"]
        assert "--insecure" in words
        assert not any("certs" in word or "tls" in word for word in words)


def test_the_page_is_reached_by_its_service_and_the_ingress_and_is_scraped_there():
    documents = rendered(**WATCHED)
    (service,) = (each for name, each in of_kind("Service", documents).items() if name == "plant-page")
    (gateway,) = (each for name, each in of_kind("StatefulSet", documents).items() if "gateway" in name)
    assert service["spec"]["selector"].items() <= gateway["spec"]["template"]["metadata"]["labels"].items()
    (port,) = service["spec"]["ports"]
    assert {"name": port["targetPort"], "containerPort": 8080} in container(gateway)["ports"]
    (ingress,) = of_kind("Ingress", documents).values()
    (rule,) = ingress["spec"]["rules"]
    (path,) = rule["http"]["paths"]
    assert path["backend"]["service"] == {"name": "plant-page", "port": {"name": port["name"]}}
    assert ingress["spec"]["tls"] == [{"hosts": [rule["host"]], "secretName": "tls"}]
    (monitor,) = of_kind("ServiceMonitor", documents).values()
    assert monitor["spec"]["selector"]["matchLabels"].items() <= service["metadata"]["labels"].items()
    assert monitor["spec"]["endpoints"][0]["port"] == port["name"]
    assert monitor["metadata"]["labels"]["release"] == "prometheus"
    users = f'{CONFIGURATION}[gateway]\nusers = "files/users.toml"\n'
    words = [word.replace("$(SHARD)", "1") for word in container(gateway)["args"]]
    settings = parse_config(users, Path("fantwin.toml"), parsed(words)["overrides"], stages=("gateway",))
    section: Any = settings.sections["gateway"]
    assert (section.host, section.port, section.is_https) == ("0.0.0.0", 8080, True)


def test_rules_and_dashboard_are_those_of_the_other_deployments():
    documents = rendered(**WATCHED)
    (rules,) = of_kind("PrometheusRule", documents).values()
    assert rules["spec"] == yaml.safe_load((DEPLOY / "prometheus" / "fantwin.rules.yml").read_text())
    board = of_kind("ConfigMap", documents)["plant-dashboards"]
    assert json.loads(board["data"]["fantwin.json"]) == json.loads((DEPLOY / "grafana" / "fantwin.json").read_text())
    assert board["metadata"]["labels"]["grafana_dashboard"] == "1"


def test_pods_are_placed_and_named_as_the_values_say():
    documents = rendered(**WATCHED, fullnameOverride="cooling")
    pods = [*of_kind("StatefulSet", documents).values(), *of_kind("Deployment", documents).values()]
    assert all(
        each["metadata"]["name"].startswith("cooling-") for each in documents if each["kind"] != "ServiceAccount"
    )
    for each in pods:
        spec = each["spec"]["template"]["spec"]
        assert spec["tolerations"] == WATCHED["tolerations"] and spec["nodeSelector"] == {"disk": "fast"}
        assert (spec["serviceAccountName"], spec["automountServiceAccountToken"]) == ("fans", False)
    claims = [claim for each in pods for claim in each["spec"].get("volumeClaimTemplates", ())]
    assert claims and all(claim["spec"]["storageClassName"] == "ssd" for claim in claims)
    (router,) = of_kind("Deployment", rendered(nameOverride="fans")).values()
    assert router["metadata"]["name"] == "plant-fans-router"


def test_the_notes_say_where_the_page_is():
    def notes(**values: Any) -> str:
        (found,) = (text for path, text in files(**values).items() if path.endswith("NOTES.txt"))
        return found

    assert "Operators' page: https://fans.example/" in notes(**WATCHED)
    assert "port-forward svc/plant-page 8080:80" in notes(**ONE_PAGE)
    assert "There is no operators' page" in notes() and "tls/plant-router:7447" in notes()
