"""`.ci/run` fails, and says why in its last line, where tests died, failed or did not run."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

RUN = Path(__file__).parents[2] / ".ci" / "run"
ABORTS = "import os; os.abort()"


def last_line(folder, script):
    """Status and last line of what a script makes of the functions of `.ci/run`."""
    own = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST")}
    own |= {"PATH": f"{Path(sys.executable).parent}:{own['PATH']}", "TMPDIR": str(folder)}
    own |= {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "PYTEST_PLUGINS": "xdist.plugin"}
    own |= {"PYTEST_XDIST_AUTO_NUM_WORKERS": "1"}
    begin = f'source "{RUN}"; cd "{folder}"; scratch=$(mktemp -d); trap finish EXIT; '
    done = subprocess.run(
        ["bash", "-c", begin + script], env=own, capture_output=True, text=True, check=False
    )
    return done.returncode, done.stdout.splitlines()[-1]


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({"test_it.py": "def test(): pass"}, None),
        ({"test_it.py": f"def test(): {ABORTS}"}, "a worker of the tests died"),
        ({"test_it.py": "def test(): pass", "conftest.py": ABORTS}, "tests (pytest ended with"),
        ({"test_it.py": "def test(): assert False"}, "tests (pytest ended with status 1)"),
        ({}, "tests (pytest ended with status 5)"),
        ({"test_it.py": "import pytest\ndef test(): pytest.skip('')"}, "no test was executed"),
    ],
    ids=["passes", "aborts", "aborts while it starts", "fails", "none", "only skipped"],
)
def test_tests_have_to_run_and_to_pass(tmp_path, files, words):
    (tmp_path / "pytest.ini").write_text("[pytest]")
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    status, last = last_line(tmp_path, "reason=before; tests")
    if words is None:
        assert status == 0 and "1 passed" in last
    else:
        assert status != 0 and last.startswith(f"failed: {words}")


def test_what_is_not_installed_is_named(tmp_path):
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    status, last = last_line(tmp_path, f"interpreter 9.9 {version}")
    assert status == 0 and Path(last).exists()
    status, last = last_line(tmp_path, 'interpreter 9.9 || fail "Python 9.9: not found"')
    assert status == 1 and last == "failed: Python 9.9: not found"
