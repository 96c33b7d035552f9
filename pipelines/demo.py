"""`make demo`: film the simulated scene, then run the main job on the video just as a user would.

`python -m fieldfuse.pipelines.demo OPTIONS` makes `demo/` in the current folder; OPTIONS are those of `fieldfuse run` (`--budget 3`).
"""

from __future__ import annotations

import sys
from pathlib import Path

from fieldfuse.errors import FieldfuseError, Interrupted
from fieldfuse.pipelines import cli
from fieldfuse.pipelines.console import make_progress
from fieldfuse.simulate.demo import write_demo_video

FOLDER = Path("demo")


def main(folder: Path = FOLDER) -> None:
    """Make the capture in `folder` and reconstruct it into `folder`/run, with the options of the command line."""
    video = folder / "demo.mp4"
    try:
        if not video.is_file():  # with the same file, a second run reuses what the first one finished
            progress = make_progress()
            with progress.listening(), progress.stage("film"):
                write_demo_video(video, progress=progress)
    except FieldfuseError as error:
        sys.stderr.write(f"fieldfuse: {error}\n")
        sys.exit(130 if isinstance(error, Interrupted) else 2)
    sys.argv = ["fieldfuse", "run", str(video), "--out", str(folder / "run"), "--preset", "fast", *sys.argv[1:]]
    sys.stderr.write(" ".join(sys.argv) + "\n")
    cli.main()


if __name__ == "__main__":
    main()
