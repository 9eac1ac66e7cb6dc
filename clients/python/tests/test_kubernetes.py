"""The Kubernetes manifests: strict schemas, and that the program has what they name."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import re
import shlex
import subprocess
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import kubernetes_validate  # type: ignore[import-untyped]
import pytest
import wildcity
import yaml  # type: ignore[import-untyped]
from test_end_to_end import import_corridor

TOKEN = "a-token-of-the-fleet"
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


def container() -> Any:
    (one,) = manifest("statefulset.yaml")["spec"]["template"]["spec"]["containers"]
    return one


def parsed(toml: str) -> dict[str, Any]:
    """Texts and numbers, which TOML writes as JSON does. Python 3.10 has no module for TOML."""
    return {name: json.loads(value) for name, value in re.findall(r"^(\w+) = (.+)$", toml, re.MULTILINE)}


def options() -> dict[str, Any]:
    """The options of the pods' servers."""
    return parsed((MANIFESTS / "wildcity.toml").read_text())


def test_the_program_has_the_options() -> None:
    binary = os.environ["WILDCITY_BIN"]
    printing = [binary, "serve", "--config", str(MANIFESTS / "wildcity.toml"), "--print-config"]
    done = subprocess.run(printing, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    printed = parsed(done.stdout)
    assert len(options()) > 10
    for name, value in options().items():
        assert printed[name] == value, name


def test_only_the_autoscaler_sets_the_number_of_pods() -> None:
    # `kubectl apply` would set it back.
    assert "replicas" not in manifest("statefulset.yaml")["spec"]


def test_old_records_go_before_episodes_are_refused() -> None:
    printing = [os.environ["WILDCITY_BIN"], "serve", "--config", str(MANIFESTS / "wildcity.toml"), "--print-config"]
    printed = parsed(subprocess.run(printing, capture_output=True, text=True, check=True).stdout)
    assert printed["keep_records_gib"] < min(printed["token_records_gib"], printed["records_gib"])


def test_ports_mounts_and_secrets_are_those_of_the_options() -> None:
    pods = manifest("statefulset.yaml")["spec"]["template"]
    ports = {port["name"]: port["containerPort"] for port in container()["ports"]}
    assert options()["listen"] == f"0.0.0.0:{ports['http']}"
    assert options()["metrics_listen"] == f"0.0.0.0:{ports['metrics']}"
    annotations = pods["metadata"]["annotations"]
    assert annotations["prometheus.io/port"] == str(ports["metrics"])
    mounts = [mount["mountPath"] for mount in container()["volumeMounts"]]
    for name in ("cache_dir", "episodes", "uploads", "tokens"):
        assert any(options()[name].startswith(mount) for mount in mounts), name
    # The image has a program, and no tools but bash: nothing else runs in a pod.
    assert "lifecycle" not in container()
    # The server ends before it is killed.
    grace_s = pods["spec"]["terminationGracePeriodSeconds"]
    assert grace_s >= options()["sessions_end_s"] + 2 * 10 + 30
    # A session that lost its connection can be resumed while its pod waits for it.
    assert manifest("service.yaml")["spec"]["publishNotReadyAddresses"] is True


def test_the_commands_of_the_readme_fit_the_manifests() -> None:
    block, signal = re.findall(r"```\n(.*?)```", (MANIFESTS / "README.md").read_text(), re.DOTALL)
    labels = manifest("statefulset.yaml")["spec"]["template"]["metadata"]["labels"]
    (selector,) = re.findall(r"--selector (\S+)=(\S+)", signal)
    assert labels[selector[0]] == selector[1]
    commands = [shlex.split(line) for line in block.replace("\\\n", " ").splitlines()]
    namespace = manifest("namespace.yaml")["metadata"]["name"]
    assert KUSTOMIZATION["namespace"] == namespace
    kinds = [command[1:3] for command in commands]
    # Secrets need the namespace, and pods the secrets.
    assert f"--namespace {namespace} " in signal
    assert kinds == [["apply", "-f"], ["create", "secret"], ["create", "secret"], ["apply", "-k"]]
    root = MANIFESTS.parents[1]
    assert root / commands[0][3] == MANIFESTS / "namespace.yaml" and root / commands[3][3] == MANIFESTS
    made = {}
    for command in commands[1:3]:
        assert command[5:7] == ["--namespace", namespace]
        literals = [value.split("=")[0] for flag, value in itertools.pairwise(command) if flag == "--from-literal"]
        files = [value for flag, value in itertools.pairwise(command) if flag == "--from-file"]
        made[command[4]] = {*literals, *files}
    pod = manifest("statefulset.yaml")["spec"]["template"]["spec"]
    (environment,) = container()["envFrom"]
    (secret,) = (volume["secret"]["secretName"] for volume in pod["volumes"] if "secret" in volume)
    assert made == {
        secret: {Path(options()["tokens"]).name},
        environment["secretRef"]["name"]: {"AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_REGION"},
    }


@contextlib.contextmanager
def serving(folder: Path, *arguments: str) -> Iterator[tuple[subprocess.Popen[str], str, str]]:
    """A server with tokens and a listener for metrics: its process and the addresses of both listeners."""
    tokens = {"tokens": [{"name": "fleet", "role": "drive", "token": TOKEN}]}
    (folder / "tokens.json").write_text(json.dumps(tokens))
    command = [os.environ["WILDCITY_BIN"], "serve", "--tokens", str(folder / "tokens.json"), "--listen", "127.0.0.1:0"]
    command += ["--metrics-listen", "127.0.0.1:0", "--backend", "cpu", "--mcap", "false", *import_corridor(folder)]
    command += ["--episodes", str(folder / "episodes"), "--uploads", str(folder / "uploads"), *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None and process.stderr is not None
            url = process.stdout.readline().split()[-1]
            for line in process.stderr:
                if "metrics at" in line:
                    break
            yield process, url, line.split("metrics at ")[1].strip().removesuffix("/metrics")
        finally:
            process.kill()


def status(address: str) -> int:
    try:
        with urllib.request.urlopen(address, timeout=30) as answer:
            return int(answer.status)
    except urllib.error.HTTPError as error:
        return error.code


def test_probes_and_prometheus_need_no_token(tmp_path: Path) -> None:
    with serving(tmp_path) as (_, url, metrics):
        served = url.replace("ws://", "http://").removesuffix("/v1/session")
        assert status(f"{served}/metrics") == 401
        (metric,) = manifest("autoscaler.yaml")["spec"]["metrics"]
        path = manifest("statefulset.yaml")["spec"]["template"]["metadata"]["annotations"]["prometheus.io/path"]
        with urllib.request.urlopen(metrics + path, timeout=30) as answer:
            text = answer.read().decode()
        assert metric["pods"]["metric"]["name"] in {line.split()[0] for line in text.splitlines()}
        assert "corridor" not in text and "fleet" not in text
        for probe in ("startupProbe", "readinessProbe", "livenessProbe"):
            asked = container()[probe]["httpGet"]
            assert asked["port"] == "metrics" and status(metrics + asked["path"]) == 200
        # Everything else needs the first listener.
        assert status(f"{metrics}/v1/twins") == 404


def test_a_pod_that_stops_waits_for_its_sessions(tmp_path: Path) -> None:
    with serving(tmp_path, "--sessions-end-s", "60") as (process, url, metrics):
        with wildcity.connect(url, token=TOKEN) as client:
            with client.open("corridor") as session:
                session.reset()
                process.terminate()
                while status(f"{metrics}/readyz") == 200:
                    pass
                with wildcity.connect(url, token=TOKEN) as other, pytest.raises(wildcity.Refused) as refused:
                    other.open("corridor")
                assert refused.value.code == "shutting_down"
                assert session.step(wildcity.Pose((1.0, 0.0, 0.0))).metadata.step == 1
                assert process.poll() is None
            assert process.wait(timeout=30) == 0


def test_a_second_signal_ends_the_wait(tmp_path: Path) -> None:
    with serving(tmp_path, "--sessions-end-s", "600") as (process, url, metrics):
        client = wildcity.connect(url, token=TOKEN)
        client.open("corridor").reset()
        process.terminate()
        while status(f"{metrics}/readyz") == 200:
            pass
        process.terminate()
        assert process.wait(timeout=30) == 0
