"""Settings of short runs on the made-up room, and what their reports hold."""

from __future__ import annotations

import subprocess
import time
from pathlib import Path
from typing import Any

from tests.pipelines.made import command, environment
from toolkit.files import read_json

ALONE = ["--threads", "1", "--init", "classical"]
SMALL = ["--budget", "3", *ALONE, "--set", "field.resolution=32", "--set", "export.mesh_views=6", "--set", "export.video_frames=4"]
FAST = ["--budget", "1", *ALONE, "--set", "field.resolution=16", "--set", "export.formats=[points]", "--set", "export.mesh_views=3"]


def report(folder: Path) -> dict[str, Any]:
    data = read_json(folder / "report.json")
    assert isinstance(data, dict)
    return data


def stages(data: dict[str, Any]) -> dict[str, bool]:
    return {stage["name"]: stage["cached"] for stage in data["stages"]}


def start(*arguments: object) -> subprocess.Popen[str]:
    return subprocess.Popen(command(*arguments), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment())


def wait_for(path: Path, process: subprocess.Popen[str], seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not path.exists():
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < end, f"{path} never came"
        time.sleep(0.02)
