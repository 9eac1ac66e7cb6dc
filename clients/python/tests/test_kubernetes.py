"""The Kubernetes manifests: strict schemas, and that the program has what they name."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from typing import Any

import kubernetes_validate  # type: ignore[import-untyped]
import pytest
import yaml  # type: ignore[import-untyped]
from test_end_to_end import Server, server

MANIFESTS = Path(__file__).resolve().parents[2] / "kubernetes"
KUSTOMIZATION = yaml.safe_load((MANIFESTS / "kustomization.yaml").read_text())
RESOURCES = KUSTOMIZATION["resources"]


def manifest(name: str) -> Any:
    return yaml.safe_load((MANIFESTS / name).read_text())


@pytest.mark.parametrize("name", RESOURCES)
def test_a_manifest_is_valid(name: str) -> None:
    assert kubernetes_validate.validate(manifest(name), desired_version="1.30", strict=True)


def test_an_unknown_field_is_found() -> None:
    broken = manifest("statefulset.yaml")
    broken["spec"]["template"]["spec"]["containers"][0]["readynessProbe"] = {}
    with pytest.raises(kubernetes_validate.ValidationError):
        kubernetes_validate.validate(broken, desired_version="1.30", strict=True)


def test_every_file_is_named() -> None:
    generated = [file for entry in KUSTOMIZATION["configMapGenerator"] for file in entry["files"]]
    named = {*RESOURCES, *generated, "kustomization.yaml", "README.md"}
    assert named == {path.name for path in MANIFESTS.iterdir()}


def test_all_select_the_same_pods() -> None:
    pods = manifest("statefulset.yaml")["spec"]
    labels = pods["template"]["metadata"]["labels"]
    assert pods["selector"]["matchLabels"] == labels
    assert manifest("service.yaml")["spec"]["selector"] == labels
    assert manifest("disruption.yaml")["spec"]["selector"]["matchLabels"] == labels
    assert pods["serviceName"] == manifest("service.yaml")["metadata"]["name"]
    assert manifest("autoscaler.yaml")["spec"]["scaleTargetRef"]["name"] == "wildcity"


def test_the_program_has_the_options_routes_and_metrics(server: Server) -> None:
    binary = os.environ["WILDCITY_BIN"]
    printing = [binary, "serve", "--config", str(MANIFESTS / "wildcity.toml"), "--print-config"]
    done = subprocess.run(printing, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (container,) = manifest("statefulset.yaml")["spec"]["template"]["spec"]["containers"]
    for probe in ("startupProbe", "readinessProbe", "livenessProbe"):
        assert server.get(container[probe]["httpGet"]["path"])[0] == 200
    (metric,) = manifest("autoscaler.yaml")["spec"]["metrics"]
    names = {line.split()[0] for line in server.get("/metrics")[1].splitlines()}
    assert metric["pods"]["metric"]["name"] in names
    hook = container["lifecycle"]["preStop"]["exec"]["command"][-1]
    assert "/v1/sessions" in hook and '"session"' not in server.get("/v1/sessions")[1]
