"""What environments are made of, from gymnax, without the libraries that draw its own games.

To import those takes longer than to import JAX. gymnax gets them when it first draws.
"""

import importlib
import sys
import types
from typing import Any

_DRAWING = "matplotlib.pyplot", "seaborn"


class _Later(types.ModuleType):
    """A module that is imported when something of it is used."""

    def __getattr__(self, name: str) -> Any:
        return getattr(importlib.import_module(self.__name__), name)


_later = {name: _Later(name) for name in _DRAWING if name not in sys.modules}
sys.modules.update(_later)
try:
    from gymnax.environments.environment import Environment, EnvParams, EnvState
    from gymnax.environments.spaces import Box, gymnax_space_to_gym_space
finally:
    for _name in _later:
        del sys.modules[_name]  # Others import them as always.

__all__ = ["Box", "EnvParams", "EnvState", "Environment", "gymnax_space_to_gym_space"]
