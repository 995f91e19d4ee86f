"""Typed configuration: YAML files and the command line, read strictly into frozen dataclasses.

Fields may be `bool`, `int`, `float`, `str`, `Path`, `Literal`, tuples, unions of these (so also
optional ones) and nested dataclasses. Bounds are said in annotations, like `Positive`; `settings`
makes a dataclass that checks them, whether it is made in Python, from YAML or by a command line.
"""

import argparse
import contextlib
import dataclasses
import difflib
import functools
import inspect
import math
import re
import sys
import types
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import (
    Annotated,
    Any,
    Literal,
    TypeVar,
    Union,
    cast,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
import tyro
import yaml

from vertiwm_jax import xla
from vertiwm_jax.errors import UserError

T = TypeVar("T")

_PACKAGE = Path(__file__).resolve().parent
_FOLDERS = (_PACKAGE / "configs", _PACKAGE.parent / "configs")


class ConfigError(UserError, ValueError):
    """A configuration that cannot be used; the message names file, field and mend."""


@dataclasses.dataclass(frozen=True)
class Bounds:
    """Where a number has to lie, or each number of a tuple; for `Annotated`."""

    low: float
    high: float = math.inf
    open: bool = False
    """Whether the bounds themselves are left out."""

    def __contains__(self, value: float) -> bool:
        if not (self.low < value if self.open else self.low <= value):
            return False
        return self.high == math.inf or (value < self.high if self.open else value <= self.high)

    def __str__(self) -> str:
        low, high = f"{self.low:g}", f"{self.high:g}"
        if self.high == math.inf:
            return f"{'more than' if self.open else 'at least'} {low}"
        return f"between {low} and {high}" if self.open else f"{low} to {high}"


class AtLeastOne:
    """Says that a tuple may not be empty; for `Annotated`."""


Positive = Annotated[float, Bounds(0, open=True)]
NotNegative = Annotated[float, Bounds(0)]
Share = Annotated[float, Bounds(0, 1)]
Discount = Annotated[float, Bounds(0, 1, open=True)]
Count = Annotated[int, Bounds(1)]
CountOrZero = Annotated[int, Bounds(0)]


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
def settings(cls: type[T]) -> type[T]:
    """A frozen dataclass whose values are checked whenever one is made.

    Numbers have to lie within the `Bounds` of their annotations. Then the method `check`, if there
    is one, looks at what joins several fields. Values that are refused raise `ConfigError`, or what
    `check` raises.
    """

    def check_all(self: Any) -> None:
        for name, bounds in _bounds_of_fields(type(self)):
            value = getattr(self, name)
            if bounds is AtLeastOne:
                if not value:
                    raise ConfigError(f"{name}: expected at least one, found none")
            elif value is not None:
                numbers = value if isinstance(value, tuple) else (value,)
                if not all(number in bounds for number in numbers):
                    raise ConfigError(f"{name}: expected {bounds}, found {value}")
        if hasattr(self, "check"):
            self.check()

    cls.__post_init__ = check_all  # pyright: ignore[reportAttributeAccessIssue]
    return dataclasses.dataclass(frozen=True)(cls)


@functools.cache
def _bounds_of_fields(cls: Any) -> list[tuple[str, Any]]:
    hints = get_type_hints(cls, include_extras=True)
    fields = dataclasses.fields(cls)
    return [(field.name, bounds) for field in fields for bounds in _bounds(hints[field.name])]


def _bounds(kind: Any) -> Iterator[Any]:
    for part in get_args(kind):
        if isinstance(part, Bounds) or part is AtLeastOne:
            yield part
        yield from _bounds(part)


def default_config(name: str) -> Path:
    """The YAML file `name` (without ending; `folder/name` in a folder) that comes along.

    An installed wheel carries the files in the package, a checkout beside it. An unknown name
    raises `ConfigError`.
    """
    for folder in _FOLDERS:
        path = folder / f"{name}.yaml"
        if path.is_file():
            return path
    inside, name = Path(name).parent, Path(name).name
    known = [path.stem for folder in _FOLDERS for path in sorted((folder / inside).glob("*.yaml"))]
    raise ConfigError(f"no configuration named {name!r}: expected {_choices(name, known)}")


def load(cls: type[T], path: str | Path) -> T:
    """Read the YAML file at `path` into the dataclass `cls`.

    Keys that the file leaves out take the dataclass's defaults; within a nested dataclass, those of
    the default instance. A missing file, an unknown,
    repeated, missing or ill-typed key, or a value that the dataclass refuses raises
    `ConfigError`.
    """
    path = Path(path)
    try:
        tree = yaml.load(path.read_text(encoding="utf-8"), _Loader)
    except FileNotFoundError as error:
        beside = [file.name for file in sorted(path.parent.glob("*.y*ml"))]
        hint = f": expected {_choices(path.name, beside)} in {path.parent}" if beside else ""
        raise ConfigError(f"{path}: no such file{hint}") from error
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: expected a readable UTF-8 file, found: {error}") from error
    except yaml.YAMLError as error:
        raise ConfigError(f"{path}: not valid YAML: {' '.join(str(error).split())}") from error
    try:
        return _convert({} if tree is None else tree, cls, "")
    except _MismatchError as error:
        raise ConfigError(f"{path}: {error}") from None


def dump(config: Any) -> str:
    """A configuration as YAML text, which `load` reads back equal."""
    return yaml.dump(_plain(config), Dumper=_Dumper, sort_keys=False)


def save(config: Any, path: str | Path) -> None:
    """Write a configuration to `path` as YAML, which `load` reads back equal."""
    Path(path).write_text(dump(config), encoding="utf-8")


def parse(
    cls: type[T],
    default_file: str | Path,
    argv: Sequence[str] | None = None,
    prog: str | None = None,
) -> T:
    """Read a command line: `[--config FILE] [--any.field VALUE] [--verbose]`.

    `--config` replaces `default_file`; every field can then be set by its dotted name, with
    dashes or underscores. `argv` defaults to the process's arguments, `prog` to its name. Bad
    input ends the process with status 2 and an error that names the file or option, as
    `argparse` does.
    """
    argv = sys.argv[1:] if argv is None else argv
    first = argparse.ArgumentParser(prog=prog, add_help=False, allow_abbrev=False)
    first.add_argument("--config", type=Path, default=Path(default_file))
    file = first.parse_known_args(argv)[0].config
    try:
        config = load(cls, file)
    except ConfigError as error:
        first.exit(2, f"{first.prog}: error: {error}\n")
    file_help = "YAML file that gives the fields below their values."
    verbose_help = "Say which options of the compiler are left out, as it does not know them."
    # tyro sees these as options like others, so that the help shows them.
    command_line = dataclasses.make_dataclass(
        "CommandLine",
        [
            ("config", Annotated[Path, tyro.conf.arg(help=file_help)], file),
            ("verbose", Annotated[bool, tyro.conf.arg(help=verbose_help)], False),
            ("fields", tyro.conf.FlagConversionOff[Annotated[cls, tyro.conf.arg(name="")]], config),
        ],
    )
    try:
        given = tyro.cli(
            command_line,
            args=argv,
            prog=prog,
            description=inspect.getdoc(cls),
            config=(tyro.conf.AvoidSubcommands, tyro.conf.FlagCreatePairsOff),
        )
    except ValueError as error:  # tyro lets through what the outermost dataclass refuses
        first.exit(2, f"{first.prog}: error: {error}\n")
    if given.verbose:
        print(f"compiler options left out: {', '.join(xla.left_out()) or 'none'}", flush=True)
    return given.fields


def parse_resumable(cls: type[T], name: str, argv: Sequence[str] | None, program: str) -> T:
    """`parse` with the file `name` that comes with the package, or that of the run to `--resume`.

    cls: has a field `resume`, the folder of a run, or None.
    """
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--resume", type=Path)
    resume = first.parse_known_args(argv)[0].resume
    file = resume / "config.yaml" if resume else default_config(name)
    return parse(cls, file, argv, program)


class _MismatchError(Exception):
    """A value that does not fit its field; the message starts with the dotted field."""


def _convert(value: Any, kind: Any, field: str) -> Any:
    """`value` as read from YAML, as an instance of the type `kind`."""
    origin, args = get_origin(kind), get_args(kind)
    if dataclasses.is_dataclass(kind):
        return _convert_dataclass(value, kind, field)
    if origin in (Union, types.UnionType):
        nested = [option for option in args if dataclasses.is_dataclass(option)]
        if isinstance(value, dict) and len(nested) == 1:
            return _convert_dataclass(value, nested[0], field)
        for option in args:
            with contextlib.suppress(_MismatchError):
                return _convert(value, option, field)
        raise _mismatch(value, kind, field)
    if origin is Literal:
        if any(value == option and type(value) is type(option) for option in args):
            return value
        raise _mismatch(value, kind, field)
    if origin is tuple:
        if not isinstance(value, list):
            raise _mismatch(value, kind, field)
        kinds = args[:1] * len(value) if args[-1] is Ellipsis else args
        if len(kinds) != len(value):
            raise _mismatch(value, kind, field)
        return tuple(
            _convert(item, kind, f"{field}[{i}]")
            for i, (item, kind) in enumerate(zip(value, kinds, strict=True))
        )
    if kind is types.NoneType:
        if value is not None:
            raise _mismatch(value, kind, field)
        return None
    if kind is Path and isinstance(value, str):
        return Path(value)
    if kind is float and type(value) is int:
        return float(value)
    if kind not in (bool, int, float, str, Path):
        raise TypeError(f"{field}: fields of type {kind} cannot be read from YAML")
    if type(value) is not kind:
        raise _mismatch(value, kind, field)
    return value


def _convert_dataclass(value: Any, cls: Any, field: str, base: Any = None) -> Any:
    """base: an instance whose values stand where the mapping has none; else those of the class."""
    if not isinstance(value, dict):
        raise _mismatch(value, cls, field)
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init}
    for key in value:
        if key not in fields:
            expected = _choices(str(key), fields)
            raise _MismatchError(f"{_join(field, key)}: unknown key, expected {expected}")
    for name, f in fields.items():
        no_default = f.default is f.default_factory is dataclasses.MISSING
        if base is None and no_default and name not in value:
            expected = _describe(get_type_hints(cls)[name])
            raise _MismatchError(f"{_join(field, name)}: missing, expected {expected}")
    kinds = get_type_hints(cls)
    converted = {}
    for key, item in value.items():
        kind, inner = kinds[key], getattr(base, key, fields[key].default)
        if dataclasses.is_dataclass(kind) and isinstance(inner, cast(type, kind)):
            converted[key] = _convert_dataclass(item, kind, _join(field, key), inner)
        else:
            converted[key] = _convert(item, kind, _join(field, key))
    try:
        return dataclasses.replace(base, **converted) if base else cls(**converted)
    except ValueError as error:
        prefix = f"{field}: " if field else ""
        raise _MismatchError(f"{prefix}{error}") from error


def _mismatch(value: Any, kind: Any, field: str) -> _MismatchError:
    message = f"{field or 'the file'}: expected {_describe(kind)}, found {_found(value)}"
    if get_origin(kind) is Literal and isinstance(value, str):
        message += _hint(value, [str(option) for option in get_args(kind)])
    return _MismatchError(message)


def _describe(kind: Any) -> str:
    origin, args = get_origin(kind), get_args(kind)
    if dataclasses.is_dataclass(kind):
        return f"a mapping of {getattr(kind, '__name__', kind)} fields"
    if origin in (Union, types.UnionType):
        return " or ".join(_describe(option) for option in args)
    if origin is Literal:
        return "one of " + ", ".join(repr(option) for option in args)
    if origin is tuple:
        if args[-1] is Ellipsis:
            return f"a list of {_describe(args[0])}"
        return f"a list of {len(args)} ({', '.join(_describe(option) for option in args)})"
    return {types.NoneType: "null", Path: "a path"}.get(kind) or kind.__name__


def _found(value: Any) -> str:
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    return "null" if value is None else f"{value!r} ({type(value).__name__})"


def _choices(name: str, known: Iterable[str]) -> str:
    known = list(known)
    return f"one of {', '.join(known) or '(none)'}{_hint(name, known)}"


def _hint(name: str, known: Iterable[str]) -> str:
    closest = difflib.get_close_matches(name, known, n=1)
    return f"; did you mean {closest[0]!r}?" if closest else ""


def _join(field: str, key: Any) -> str:
    return f"{field}.{key}" if field else str(key)


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        names = [f.name for f in dataclasses.fields(value) if f.init]
        return {name: _plain(getattr(value, name)) for name in names}
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        return value.item()
    return str(value) if isinstance(value, Path) else value


class _Loader(yaml.SafeLoader):
    """YAML as people write it: `3e-4` is a number, and a repeated key is an error."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            if key_node.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"repeated key {key_node.value!r}", key_node.start_mark
                )
            seen.add(key_node.value)
        return super().construct_mapping(node, deep)


class _Dumper(yaml.SafeDumper):
    """Quotes the strings that `_Loader` would read as numbers; writes lists on one line."""


# YAML 1.1 takes an exponent only after a point and with a sign.
_EXPONENT = re.compile(r"^[-+]?[0-9][0-9_]*(\.[0-9_]*)?[eE][-+]?[0-9]+$")
for _class in (_Loader, _Dumper):
    _class.add_implicit_resolver("tag:yaml.org,2002:float", _EXPONENT, list("-+0123456789"))
_Dumper.add_representer(
    list, lambda dumper, data: dumper.represent_sequence("tag:yaml.org,2002:seq", data, True)
)
