"""The manifest of docs/howto/cluster.md: consistent in itself, and its commands are those of a cluster that works."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import page_blocks
import pytest
import yaml
from small_runs import Finished, environment, products, run_arguments, wait_for

from coslidar.flows.jobs import ONE_THREAD
from coslidar.flows.settings import load

Call = Callable[..., Finished]
PAGE = page_blocks.ROOT / "docs" / "howto" / "cluster.md"


def manifest() -> dict[tuple[str, str], dict[str, Any]]:
    """Objects by kind and name."""
    (text,) = [block.body for block in page_blocks.blocks(PAGE) if block.file == "kubernetes.yaml"]
    found = [one for one in yaml.safe_load_all(text) if one]
    return {(one["kind"], one["metadata"]["name"]): one for one in found}


def container(name: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """The pod of a deployment, and its only container."""
    pod = manifest()["Deployment", name]["spec"]["template"]
    (only,) = pod["spec"]["containers"]
    return pod, only


def option(command: list[str], name: str) -> str:
    return command[command.index(name) + 1]


def test_the_manifest_fits_together(tmp_path: Path) -> None:
    objects = manifest()
    assert set(objects) == {
        ("Service", "dask-scheduler"),
        ("Deployment", "dask-scheduler"),
        ("Deployment", "dask-worker"),
    }
    assert {one["metadata"]["namespace"] for one in objects.values()} == {"turbulence"}
    for name in ("dask-scheduler", "dask-worker"):
        pod, only = container(name)
        labels = pod["metadata"]["labels"]
        assert objects["Deployment", name]["spec"]["selector"]["matchLabels"] == labels
        volumes = {volume["name"] for volume in pod["spec"]["volumes"]}
        mounts = {mount["name"]: mount["mountPath"] for mount in only["volumeMounts"]}
        assert set(mounts) == volumes
        for flag in ("--tls-ca-file", "--tls-cert", "--tls-key"):
            assert option(only["command"], flag).startswith(f"{mounts['tls']}/")
        # Whatever is a number for Kubernetes is text for a command.
        assert all(isinstance(word, str) for word in only["command"])
        assert all(isinstance(variable["value"], str) for variable in only.get("env", ()))
    scheduler, worker = container("dask-scheduler")[1], container("dask-worker")[1]
    service = objects["Service", "dask-scheduler"]["spec"]
    assert service["selector"] == container("dask-scheduler")[0]["metadata"]["labels"]
    (port,) = service["ports"]
    assert port["targetPort"] == scheduler["ports"][0]["name"]
    assert str(port["port"]) == option(scheduler["command"], "--port") == str(scheduler["ports"][0]["containerPort"])
    address = f"tls://dask-scheduler.turbulence.svc:{port['port']}"
    assert worker["command"][2] == address
    mounts = [mount["mountPath"] for mount in worker["volumeMounts"]]
    variables = {variable["name"]: variable["value"] for variable in worker["env"]}
    assert variables["COSLIDAR_HOME"].startswith(tuple(mounts))  # the image is read only for its user
    assert {name: variables[name] for name in ONE_THREAD[:2]} == dict.fromkeys(ONE_THREAD[:2], "1")
    # The campaign file beside it means this cluster.
    told = [block.body for block in page_blocks.blocks(PAGE) if address in block.body and block.language == "toml"]
    (tmp_path / "tls").mkdir()
    for name in ("ca.pem", "certificate.pem", "key.pem"):
        (tmp_path / "tls" / name).touch()
    for text in told:
        (tmp_path / "campaign.toml").write_text(text)
        run = load(tmp_path / "campaign.toml").run
        assert run.scheduler == address
        assert run.tls is not None
    assert told


@pytest.mark.cluster
@pytest.mark.slow
def test_its_commands_make_a_cluster_that_computes(
    coslidar: Call, recordings: list[str], undisturbed: dict[str, bytes], cache: Path, tmp_path: Path
) -> None:
    trustme = pytest.importorskip("trustme")
    authority = trustme.CA()
    issued = authority.issue_cert("dask")
    authority.cert_pem.write_to_path(str(tmp_path / "ca.pem"))
    issued.private_key_pem.write_to_path(str(tmp_path / "key.pem"))
    (tmp_path / "certificate.pem").write_bytes(b"".join(blob.bytes() for blob in issued.cert_chain_pems))
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    address = f"tls://127.0.0.1:{port}"
    processes = []
    try:
        for name, here in (("scheduler", ["--host", "127.0.0.1"]), ("worker", ["--host", "127.0.0.1"])):
            _, only = container(f"dask-{name}")
            dask, what, *words = only["command"]
            assert (dask, what) == ("dask", name)
            # Names, port and folders of this machine instead of those of a pod.
            there = {"8786": port, "tls://dask-scheduler.turbulence.svc:8786": address, "/scratch": str(tmp_path)}
            words = [there.get(word, word.replace("/tls/", f"{tmp_path}/")) for word in words]
            with (tmp_path / f"{name}.log").open("wb") as log:
                processes.append(
                    subprocess.Popen(
                        [sys.executable, "-m", "dask", what, *words, *here],
                        stdout=log, stderr=log, cwd=tmp_path, env=environment(cache),
                    )
                )  # fmt: skip
            ready = {"scheduler": "Scheduler at", "worker": "Registered to"}[name]
            said = tmp_path / f"{name}.log"
            assert wait_for(lambda said=said, ready=ready: ready in said.read_text(), 120, 0.1), said.read_text()
        certificates = (("ca_file", "ca"), ("certificate", "certificate"), ("key", "key"))
        sets = [part for key, name in certificates for part in ("--set", f"run.tls.{key}={tmp_path / name}.pem")]
        done = coslidar(*run_arguments(recordings, tmp_path / "out", "--scheduler", address, *sets))
        assert done.code == 0, done.err
        assert products(tmp_path / "out") == undisturbed
    finally:
        for process in processes:
            process.terminate()
            process.wait(60)
