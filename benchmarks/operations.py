"""The longest operations of a step of Verti-WM, or of a part of it, as XLA runs them.

Of one device of a CPU (`taskset -c 0`), as JAX's profiler records them, which itself takes about a
microsecond a call. Loops and branches are left out, for what is in them is told by itself.
"""

import re
import tempfile
from collections import defaultdict
from pathlib import Path
from typing import Any, get_args

import jax

from benchmarks._harness import Figures, parser, report
from benchmarks.world_model_step import over_vehicles, parts
from vertiwm_jax.models.config import Size

_CALLS = 20
_AROUND = ("while", "conditional", "call")  # what other operations are in


def named(program: str) -> dict[str, tuple[str, str]]:
    """Shapes of a compiled program's operations by name, and the end of where they come from."""
    found = {}
    for line in program.splitlines():
        operation = re.match(r"\s*(?:ROOT )?%(\S+) = (\([^()]*\)|\S+) ([\w-]+)\(", line)
        if operation and operation[3] not in _AROUND:
            source = re.search(r'op_name="([^"]*)"', line)
            of = "/".join(source[1].split("/")[-2:]) if source else ""
            found[operation[1]] = re.sub(r"\{.*", "", operation[2]), of
    return found


def recorded(compiled: Any, arguments: tuple[Any, ...]) -> dict[str, tuple[float, int]]:
    """Nanoseconds in all of `_CALLS` calls, and how often, by the names of operations."""
    jax.block_until_ready(compiled(*arguments))
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            for _ in range(_CALLS):
                jax.block_until_ready(compiled(*arguments))
        (file,) = Path(folder).rglob("*.xplane.pb")
        return by_name(file)


def by_name(trace: Path) -> dict[str, tuple[float, int]]:
    """Nanoseconds of all that was recorded, and how often, by name; of a GPU only its own work."""
    profile = jax.profiler.ProfileData.from_file(str(trace))
    lines = [line for plane in profile.planes for line in plane.lines]
    if any(plane.name.startswith("/device:GPU") for plane in profile.planes):
        lines = [line for line in lines if line.name.startswith("Stream")]
    spent, calls = defaultdict[str, float](float), defaultdict[str, int](int)
    for line in lines:
        for event in line.events:
            spent[event.name] += event.duration_ns
            calls[event.name] += 1
    return {name: (spent[name], calls[name]) for name in spent}


def main() -> None:
    arguments = parser(__doc__)
    arguments.add_argument("--batch", type=int, default=128, help="vehicles")
    arguments.add_argument("--size", choices=get_args(Size), default="base", help="of Verti-WM")
    arguments.add_argument("--part", default="the whole step", help="as world_model_step has them")
    arguments.add_argument("--longest", type=int, default=30, help="how many")
    chosen = arguments.parse_args()
    known = parts(chosen.batch, chosen.size)
    if chosen.part not in known:
        arguments.error(f"--part: expected one of {', '.join(known)}, found {chosen.part}")
    part = known[chosen.part]
    compiled = over_vehicles(part).lower(*part[1]).compile()
    operations, spent = named(compiled.as_text()), recorded(compiled, part[1])
    own = sorted(spent.keys() & operations.keys(), key=lambda name: -spent[name][0])
    rows: dict[str, Figures] = {}
    for name in own[: chosen.longest]:
        nanoseconds, calls = spent[name]
        shape, source = operations[name]
        rows[name] = {
            "us_a_vehicle": nanoseconds / 1e3 / _CALLS / chosen.batch,
            "calls": calls // _CALLS,
            "shape": shape,
            "of": source,
        }
    report("operations", rows, chosen.json)


if __name__ == "__main__":
    main()
