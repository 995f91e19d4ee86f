"""Every notebook runs from top to bottom, as a reader would run it."""

import os
import shutil
from pathlib import Path

import pytest

nbclient = pytest.importorskip("nbclient", reason="needs the extra `notebooks`")
nbformat = pytest.importorskip("nbformat", reason="needs the extra `notebooks`")
pytest.importorskip("ipykernel", reason="needs the extra `notebooks`")

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
CELL_SECONDS = 1200


def environment() -> dict[str, str]:
    """That of this process, but for the flags with which tests compile: users have none."""
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
    return {**os.environ, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": "", "PYTHONPATH": path}


@pytest.mark.slow
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(notebook, tmp_path):
    folder = tmp_path / "notebooks"
    folder.mkdir()
    shutil.copy(notebook, folder)
    shutil.copy(ROOT / "notebooks" / "noisy_logs.py", folder)
    (tmp_path / "data").symlink_to(ROOT / "data")  # they read ../data
    client = nbclient.NotebookClient(
        nbformat.read(folder / notebook.name, as_version=4),
        timeout=CELL_SECONDS,
        kernel_name="python3",
        resources={"metadata": {"path": str(folder)}},
    )
    client.execute(env=environment())  # raises what a cell raises
    left = {path.name for path in folder.iterdir()} - {"__pycache__"}
    assert left == {notebook.name, "noisy_logs.py"}
