"""`python -m fieldfuse`: the command `fieldfuse`."""

from __future__ import annotations

if __name__ == "__main__":
    from fieldfuse.pipelines.cli import program

    program()
