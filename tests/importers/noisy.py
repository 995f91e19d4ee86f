"""The script beside the notebooks that writes noisy logs, as a module."""

import sys
from importlib import import_module
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2] / "notebooks"))
noisy_logs = import_module("noisy_logs")
