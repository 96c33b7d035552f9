"""The notebooks run from top to bottom; here on smaller films, so that it takes seconds."""

from __future__ import annotations

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

EXAMPLES = sorted((Path(__file__).resolve().parents[1] / "examples").glob("*.ipynb"))
SMALLER = {
    "frames=24, size=(480, 360)": "frames=14, size=(320, 240)",
    "image_size=320": "image_size=96",
    '"keyframes.most": 8': '"keyframes.most": 3',
    "budget=10": "budget=2",
    "mesh_views=20": "mesh_views=6",
}


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_a_notebook_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    book = nbformat.read(path, as_version=4)
    assert not any(cell.get("outputs") for cell in book.cells), "outputs are not committed"
    for cell in book.cells:
        for large, small in SMALLER.items():
            cell.source = cell.source.replace(large, small)
    NotebookClient(book, timeout=500, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [output.data for cell in book.cells for output in cell.get("outputs", []) if output.output_type == "display_data"]
    assert sum("image/png" in data for data in shown) >= 2
