"""Pages of the site that are made from the code: every setting, and every public name."""

import ast
import dataclasses
import inspect
import pkgutil
import re
import textwrap
import types
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

import vertiwm_jax
from vertiwm_jax.cli.collect import Collect
from vertiwm_jax.cli.compare import CompareConfig
from vertiwm_jax.cli.fit import FitConfig
from vertiwm_jax.cli.make_logs import MakeLogs
from vertiwm_jax.importers.settings import ImportSettings
from vertiwm_jax.mechanics.vehicle import VehicleConfig
from vertiwm_jax.rl.experiment import PPOTraining, SACTraining, TD3Training

COMMANDS = {
    "ppo": PPOTraining,
    "sac": SACTraining,
    "td3": TD3Training,
    "fit": FitConfig,
    "compare": CompareConfig,
    "collect": Collect,
    "import_drives --settings": ImportSettings,
    "make_logs": MakeLogs,
    "collect --vehicle": VehicleConfig,
}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Called by MkDocs once it knows the pages that are written by hand."""
    files.append(File.generated(config, "configuration.md", content=configuration()))
    for name, content in api():
        files.append(File.generated(config, f"api/{name}.md", content=content))
    return files


def configuration() -> str:
    """Every setting of the commands: type, default and meaning, a table for each dataclass."""
    lines = [
        "# Configuration",
        "",
        "Settings are frozen dataclasses. YAML files and command lines name their fields with dots "
        "(`--ppo.num-envs 512`); what a file of `configs/` says comes before these defaults.",
    ]
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
        lines += ["| setting | type | default | what |", "|---|---|---|---|", *_rows(kind)]
    return "\n".join(lines) + "\n"


def api() -> Iterator[tuple[str, str]]:
    """A page for each package and one for the modules that belong to none."""
    root = Path(vertiwm_jax.__file__).parent
    modules = list(pkgutil.iter_modules([str(root)]))
    commands = [module.name for module in modules if not module.ispkg]
    yield "vertiwm_jax", _page("vertiwm_jax", [f"vertiwm_jax.{name}" for name in commands])
    for package in (module.name for module in modules if module.ispkg):
        inside = pkgutil.iter_modules([str(root / package)])
        names = [f"vertiwm_jax.{package}.{module.name}" for module in inside]
        yield package, _page(f"vertiwm_jax.{package}", names)


def _page(title: str, modules: list[str]) -> str:
    return "\n\n".join([f"# {title}", *(f"::: {module}" for module in modules)]) + "\n"


def _nested(kind: type) -> Iterator[type]:
    """The dataclass and all those that its fields hold, once each or more."""
    yield kind
    for field_type in typing.get_type_hints(kind).values():
        for part in (field_type, *typing.get_args(field_type)):
            if dataclasses.is_dataclass(part) and isinstance(part, type):
                yield from _nested(part)


def _rows(kind: type) -> Iterator[str]:
    meanings, hints = _meanings(kind), typing.get_type_hints(kind)
    for field in dataclasses.fields(kind):
        of_it = hints[field.name]
        cells = (f"`{field.name}`", _type(of_it), _default(field))
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


def _default(field: dataclasses.Field[Any]) -> str:
    if field.default is not dataclasses.MISSING:
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
