"""The commands and files of docs/cluster.md."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from fieldfuse.files import read_json
from tests.pipelines.made import environment, make_room
from tests.pipelines.short import HUNG

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "cluster.md").read_text(encoding="utf-8")
RAY = Path(sys.executable).with_name("ray")
SMALL = ("--num-cpus=1", "--object-store-memory=80000000", "--disable-usage-stats", "--block")
OPTIONS = ("--threads", "1", "--init", "classical", "--set", "field.resolution=16", "--set", "fit.iterations=40")
FAST = ("--set", "fit.passes=null", "--set", "fit.depth_from=off", "--set", "effects=off", "--set", "export.formats=[]")


def recipe(title: str) -> str:
    found = re.search(rf"^### {title}\n(.*?)(?=^##|\Z)", PAGE, re.MULTILINE | re.DOTALL)
    assert found is not None
    return found[1]


def commands(title: str, start: str) -> list[list[str]]:
    """The commands of a recipe that begin so."""
    return [shlex.split(line) for line in re.findall(rf"^    ({start}.*)$", recipe(title), re.MULTILINE)]


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def locked(**more: str) -> dict[str, str]:
    """The environment in which the page has Ray use a token; the test's own."""
    (line,) = commands("A pool of machines by hand", "export ")
    name, _, value = line[1].partition("=")
    return environment(**{name: value, "RAY_AUTH_TOKEN": "1" * 32, **more})


@contextlib.contextmanager
def kept(words: list[str], scratch: Path) -> Iterator[None]:
    """`ray start …`, in the foreground, so that it ends with the test and no other Ray does."""
    program = [str(RAY)] if RAY.exists() else [sys.executable, "-m", "ray.scripts.scripts"]
    with (scratch / f"ray{time.monotonic_ns()}.log").open("wb") as log:
        process = subprocess.Popen([*program, *words[1:], *SMALL], stdout=log, stderr=log, env=locked(), start_new_session=True)
    try:
        yield
    finally:
        process.send_signal(signal.SIGTERM)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(20)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


@pytest.mark.long
def test_a_pool_by_hand(tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="Ray is not installed (the extra cluster)")
    for name in ("a", "b"):
        make_room(tmp_path / "captures" / name, 10)
    port = free_port()
    here = socket.gethostbyname(socket.gethostname())

    def adapted(words: list[str]) -> list[str]:
        """The page's command for this machine: its address, a free port, the test's folders, of which a shell would make names."""
        named = [word.replace("6379", str(port)).replace("HEAD", here).replace("/shared", str(tmp_path)) for word in words]
        return [name for word in named for name in (sorted(map(str, Path("/").glob(word[1:]))) if "*" in word else [word])]

    head, other = commands("A pool of machines by hand", "ray start")
    (batch,) = commands("A pool of machines by hand", "fieldfuse batch")
    with kept(adapted(head), tmp_path):
        until_open(here, port)
        with kept(adapted(other), tmp_path):
            command = [sys.executable, "-m", "fieldfuse.pipelines.cli", *adapted(batch)[1:], *OPTIONS, *FAST]
            done = subprocess.run(command, capture_output=True, text=True, env=locked(), timeout=HUNG)
        unknown = subprocess.run(command, capture_output=True, text=True, env=locked(RAY_AUTH_TOKEN="0" * 32), timeout=HUNG)
    assert unknown.returncode == 2 and "wants its token; put what `ray get-auth-token` prints at its head" in unknown.stderr, unknown.stderr
    assert done.returncode == 0, done.stderr
    rows = read_json(tmp_path / "runs" / "batch.json")["runs"]
    assert [row["state"] for row in rows] == ["done", "done"], done.stderr


def until_open(host: str, port: int, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while True:
        try:
            socket.create_connection((host, port), 1.0).close()
            return
        except OSError:
            assert time.monotonic() < end, "Ray did not start"
            time.sleep(0.2)


def blocks(title: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", recipe(title), re.MULTILINE | re.DOTALL)


def test_ray_takes_the_file_of_ray_up() -> None:
    pytest.importorskip("ray", reason="Ray is not installed (the extra cluster)")
    from ray.autoscaler._private.util import prepare_config, validate_config

    (text,) = blocks("`ray up`", "yaml")
    config = prepare_config(yaml.safe_load(text))
    validate_config(config)
    assert config["provider"]["head_ip"] not in config["provider"]["worker_ips"] and config["max_workers"] == 2


def test_the_file_for_kubernetes_is_yaml_and_the_one_for_slurm_a_script() -> None:
    (text,) = blocks("Kubernetes", "yaml")
    spec = yaml.safe_load(text)["spec"]
    assert spec["entrypoint"].startswith("fieldfuse batch ")
    pods = [spec["rayClusterSpec"]["headGroupSpec"], *spec["rayClusterSpec"]["workerGroupSpecs"]]
    assert all(pod["template"]["spec"]["volumes"] for pod in pods)
    (script,) = blocks("Slurm", "bash")
    assert subprocess.run(["bash", "-n"], input=script, text=True, check=False).returncode == 0
