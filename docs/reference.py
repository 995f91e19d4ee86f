"""Pages of the site that are made from the code: every setting, and every public name."""

import ast
import dataclasses
import enum
import importlib
import inspect
import re
import textwrap
import types
import typing
from collections.abc import Iterator
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

import vertiwm_jax
from vertiwm_jax import config as configuration_files
from vertiwm_jax.config import default_config
from vertiwm_jax.evaluation.compare import CompareConfig
from vertiwm_jax.importers.settings import ImportSettings
from vertiwm_jax.learning.experiment import FitConfig
from vertiwm_jax.mechanics.vehicle import VehicleConfig
from vertiwm_jax.rl.experiment import PPOTraining, SACTraining, TD3Training
from vertiwm_jax.simulators.collection import CollectConfig

FILES = {"ppo": "ppo", "sac": "sac", "td3": "td3", "fit": "fit_chrono", "compare": "table3"}
"""The YAML file that each of these commands reads if it is told no other."""
COMMANDS = {
    "ppo": PPOTraining,
    "sac": SACTraining,
    "td3": TD3Training,
    "fit": FitConfig,
    "compare": CompareConfig,
    "collect": CollectConfig,
    "import_drives --settings": ImportSettings,
    "collect --vehicle": VehicleConfig,
}

PACKAGE = "vertiwm_jax"
PUBLIC = {
    "State and motion": ("VehicleState", "Command", "Dynamics", "rollout", "place"),
    "Ground": (
        "TerrainMap",
        "load_map",
        "make_worlds",
        "terrain.files.save",
        "terrain.map.stack",
        "terrain.worlds.WorldConfig",
        "terrain.classes.GroundClasses",
        "terrain.soil.Soil",
    ),
    "Vehicles and models": ("Vehicle", "load_vehicle", "load_model"),
    "Recorded drives": (
        "load_drives",
        "learning.dataset.Drives",
        "prediction_errors",
        "fit",
        "identify",
        "adaptation.soil_filter.SoilFilter",
    ),
    "The task": (
        "make_env",
        "NavigationEnv",
        "env.task.NavigationConfig",
        "env.task.TaskParams",
        "env.reward.RewardConfig",
        "env.termination.TerminationReason",
        "env.gymnasium.NavigationGymEnv",
    ),
    "Policies and planners": (
        "train",
        "load_policy",
        "Policy",
        "Agent",
        "MPPI",
        "evaluate",
        "env.episodes.run_episodes",
        "env.episodes.NavigationResult",
    ),
}
"""What others may build on: names of the package, and a few inside it."""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Called by MkDocs once it knows the pages that are written by hand."""
    files.append(File.generated(config, "configuration.md", content=configuration()))
    files.append(File.generated(config, "api.md", content=api()))
    return files


def configuration() -> str:
    """Every setting of the commands: type, default and meaning, a table for each dataclass."""
    lines = [
        "# Configuration",
        "",
        "After this page you know every setting of every command, and what it is if you do not set "
        "it. YAML files and command lines name settings with dots (`--ppo.num-envs 512`). A "
        "command reads a YAML file of `configs/` unless `--config` names another; where that file "
        "sets a value, it stands in the column *default* in bold, with the file's name.",
    ]
    shipped = _shipped()
    found: dict[type, None] = {}
    for kind in COMMANDS.values():
        found |= dict.fromkeys(_nested(kind))
    commands = {kind: name for name, kind in COMMANDS.items()}
    for kind in [*commands, *(kind for kind in found if kind not in commands)]:
        title = f"`python -m vertiwm_jax.{commands[kind]}`" if kind in commands else ""
        lines += [
            "",
            f"## {kind.__name__} {{ #{_anchor(kind)} }}",
            "",
            title,
            "",
            _first_line(kind),
            "",
        ]
        lines += ["| setting | type | default | what |", "|---|---|---|---|", *_rows(kind, shipped)]
    return "\n".join(lines) + "\n"


def api() -> str:
    """Every public name: its signature, what it says of itself, and its public methods."""
    lines = [
        "# API",
        "",
        "After this page you know how each public name is called. `vw.NAME` is a name of the "
        "package itself (`import vertiwm_jax as vw`), loaded when it is used. Arrays are named by "
        "their axes: `[..., 12]` has any leading axes. Units are SI, angles are radians; frames "
        "are those of [geometry and state](method/geometry.md). Everything that is not listed here "
        "may change without notice.",
    ]
    grouped = {name for names in PUBLIC.values() for name in names}
    others = tuple(name for name in vertiwm_jax.__all__ if name not in grouped)
    for group, names in (PUBLIC | ({"More": others} if others else {})).items():
        lines += ["", f"## {group}"]
        for path in names:
            module, _, name = f"{PACKAGE}.{path}".rpartition(".")
            lines += _documented(path, getattr(importlib.import_module(module), name))
    return "\n".join(lines) + "\n"


def _documented(path: str, thing: Any) -> Iterator[str]:
    module, _, name = path.rpartition(".")
    yield from ("", f"### {name} {{ #{path.replace('.', '-').lower()} }}", "")
    yield from (f"`from {PACKAGE}.{module} import {name}`" if module else f"`vw.{name}`", "")
    yield from ("```python", _signature(thing.__name__, thing), "```", "")
    yield from _told_in_markdown(thing)
    for name, method in vars(thing).items() if inspect.isclass(thing) else ():
        function = getattr(method, "__func__", getattr(method, "func", method))
        if name.startswith("_"):
            continue
        if isinstance(method, property):
            yield from ("", f"`{thing.__name__}.{name}`: {inspect.getdoc(method) or ''}", "")
        elif not getattr(function, "__module__", "").startswith(PACKAGE):
            continue
        elif inspect.isfunction(function):
            yield from (
                "",
                "```python",
                _signature(f"{thing.__name__}.{name}", function),
                "```",
                "",
            )
            yield from _told_in_markdown(function)


def _signature(name: str, thing: Any) -> str:
    if inspect.isclass(thing) and issubclass(thing, (enum.Enum, typing.Protocol)):  # pyright: ignore
        return f"class {name}"
    parts: list[str] = []
    signature = inspect.signature(thing)
    for parameter in signature.parameters.values():
        if parameter.kind is parameter.KEYWORD_ONLY and not any(x[0] == "*" for x in parts):
            parts.append("*")
        if parameter.name not in ("self", "cls"):
            parts.append(_parameter(parameter))
    back = signature.return_annotation
    back = "" if inspect.isclass(thing) or back is signature.empty else f" -> {_annotation(back)}"
    line = f"{name}({', '.join(parts)}){back}"
    return line if len(line) < 100 else f"{name}(\n    " + ",\n    ".join(parts) + f",\n){back}"


def _parameter(parameter: inspect.Parameter) -> str:
    stars = {parameter.VAR_POSITIONAL: "*", parameter.VAR_KEYWORD: "**"}.get(parameter.kind, "")
    text, default = stars + parameter.name, parameter.default
    if parameter.annotation is not parameter.empty:
        text += f": {_annotation(parameter.annotation)}"
    if default is parameter.empty:
        return text
    plain = not dataclasses.is_dataclass(default) and not hasattr(default, "shape")
    shown = repr(default) if plain and "<" not in repr(default) else f"{type(default).__name__}()"
    return f"{text} = {shown}"


def _annotation(kind: Any) -> str:
    if typing.get_origin(kind) is typing.Annotated:
        kind = typing.get_args(kind)[0]
    text = kind.__name__ if isinstance(kind, type) and not typing.get_args(kind) else str(kind)
    return re.sub(r"\b([A-Za-z_]\w*[.])+", "", "None" if text == "NoneType" else text)


SECTION = re.compile(r"^(Args|Returns|Raises|Attributes):$")
ENTRY = re.compile(r"^(\w+(?:, \w+)*): ")


def _told_in_markdown(thing: Any) -> Iterator[str]:
    """A docstring, whose lines `name: meaning` become a list, as do those of its sections."""
    names = set(inspect.signature(thing).parameters)
    inside = in_list = False
    for line in (inspect.getdoc(thing) or "").splitlines():
        if section := SECTION.match(line):
            inside, in_list = True, False
            yield from ("", f"**{section[1]}**", "")
            continue
        inside = inside and (line.startswith(" ") or not line)
        text = line[4:] if inside else line
        entry = ENTRY.match(text)
        if entry and (inside or names & set(entry[1].split(", "))):
            if not in_list:
                yield ""
            in_list = True
            yield f"* `{entry[1].replace(', ', '`, `')}`: {text[entry.end() :]}"
        elif in_list and text.strip():
            yield f"  {text.strip()}"
        else:
            in_list = False
            yield text
    yield ""


def _nested(kind: type) -> Iterator[type]:
    """The dataclass and all those that its fields hold, once each or more."""
    yield kind
    for field_type in typing.get_type_hints(kind).values():
        for part in (field_type, *typing.get_args(field_type)):
            if dataclasses.is_dataclass(part) and isinstance(part, type):
                yield from _nested(part)


def _shipped() -> dict[tuple[type, str], list[str]]:
    """What shipped files set fields to, where that is not their default, and which files do."""
    found: dict[tuple[type, str], dict[str, dict[str, list[str]]]] = {}
    for command, name in FILES.items():
        config = configuration_files.load(COMMANDS[command], default_config(name))
        for path, parent, field in _fields(config):
            value = _default(field, getattr(parent, field.name))
            if value != _default(field):
                values = found.setdefault((type(parent), field.name), {})
                values.setdefault(value, {}).setdefault(f"{name}.yaml", []).append(path)
    return {field: list(_told(values)) for field, values in found.items()}


def _told(values: dict[str, dict[str, list[str]]]) -> Iterator[str]:
    for value, files in values.items():
        where = [
            f"{file} ({', '.join(paths)})" if len(paths) > 1 or len(values) > 1 else file
            for file, paths in files.items()
        ]
        yield f"**{value}** in {', '.join(where)}"


def _fields(config: Any, path: str = "") -> Iterator[tuple[str, Any, dataclasses.Field[Any]]]:
    """Of a configuration and those in it: where it is, the configuration, and a field of it."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from _fields(value, f"{path}.{field.name}".strip("."))
        else:
            yield path, config, field


def _rows(kind: type, shipped: dict[tuple[type, str], list[str]]) -> Iterator[str]:
    meanings, hints = _meanings(kind), typing.get_type_hints(kind)
    for field in dataclasses.fields(kind):
        of_it = hints[field.name]
        values = [_default(field), *shipped.get((kind, field.name), [])]
        cells = (f"`{field.name}`", _type(of_it), "; ".join(values))
        text = " ".join(meanings.get(field.name, "").split())
        if not text and dataclasses.is_dataclass(of_it) and isinstance(of_it, type):
            text = _first_line(of_it)
        if not text:
            raise ValueError(f"{kind.__qualname__}.{field.name}: expected a word on what it means")
        yield "| " + " | ".join([*cells, text]).replace("\n", " ") + " |"


def _type(annotation: Any) -> str:
    options = typing.get_args(annotation) if isinstance(annotation, types.UnionType) else ()
    if options:
        return " or ".join(_type(option) for option in options)
    if dataclasses.is_dataclass(annotation) and isinstance(annotation, type):
        return f"[{annotation.__name__}](#{_anchor(annotation)})"
    is_plain = isinstance(annotation, type) and not typing.get_args(annotation)
    text = annotation.__name__ if is_plain else str(annotation)
    name = re.sub(r"\b(\w+[.])+", "", text)
    return f"`{name}`" if name != "NoneType" else "none"


def _anchor(kind: type) -> str:
    """Unique, where dataclasses of several modules have the same name."""
    return f"settings-{kind.__module__}-{kind.__name__}".replace(".", "-").lower()


def _default(field: dataclasses.Field[Any], given: Any = dataclasses.MISSING) -> str:
    """Of a field, or another value that it is given."""
    if given is not dataclasses.MISSING:
        value = given
    elif field.default is not dataclasses.MISSING:
        value = field.default
    elif field.default_factory is not dataclasses.MISSING:
        value = field.default_factory()
    else:
        return "required"
    return "see there" if dataclasses.is_dataclass(value) else f"`{value}`"


def _first_line(kind: type) -> str:
    return (inspect.getdoc(kind) or "").partition("\n")[0]


def _meanings(kind: type) -> dict[str, str]:
    """What is said of each field: below it, or as `name: ...` in the dataclass's docstring."""
    meanings: dict[str, str] = {}
    for parent in reversed(kind.__mro__[:-1]):
        if not dataclasses.is_dataclass(parent):
            continue
        said = re.findall(
            r"^(\w+(?:, \w+)*): (.*(?:\n    .*)*)", inspect.getdoc(parent) or "", re.M
        )
        for names, text in said:
            meanings |= dict.fromkeys(names.split(", "), text)
        (definition,) = ast.parse(textwrap.dedent(inspect.getsource(parent))).body
        assert isinstance(definition, ast.ClassDef)
        for field, below in zip(definition.body, definition.body[1:], strict=False):
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
                match below:
                    case ast.Expr(value=ast.Constant(value=str(text))):
                        meanings[field.target.id] = text
    return meanings
