"""Typed configuration: YAML files, read strictly into frozen dataclasses.

Fields may be `bool`, `int`, `float`, `str`, `Path`, `Literal`, tuples, unions of these (so also
optional ones) and nested dataclasses. Bounds are said in annotations, like `Positive`; `settings`
makes a dataclass that checks them, whether it is made in Python, from YAML or by a command line.
"""

import contextlib
import dataclasses
import difflib
import functools
import math
import re
import types
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import (
    Annotated,
    Any,
    Literal,
    TypeVar,
    Union,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
import yaml

from vertiwm_jax.errors import UserError

T = TypeVar("T")

_PACKAGE = Path(__file__).resolve().parent
_LARGEST = 2**63 - 1  # that an array can hold
_FOLDERS = (_PACKAGE / "configs", _PACKAGE.parent / "configs")


class ConfigError(UserError, ValueError):
    """A configuration that cannot be used; the message names file, field and mend."""


@dataclasses.dataclass(frozen=True)
class Bounds:
    """What a setting has to be, in words and as a test of a value; for `Annotated`."""

    words: str
    holds: Callable[[Any], bool]
    of_each: bool = True
    """Whether each entry of a tuple is tested, or the tuple."""

    def refuses(self, value: Any) -> bool:
        """Whether the value is out of bounds; None never is."""
        each = value if self.of_each and isinstance(value, tuple) else (value,)
        return value is not None and not all(map(self.holds, each))


Positive = Annotated[float, Bounds("more than 0", lambda x: x > 0)]
NotNegative = Annotated[float, Bounds("at least 0", lambda x: x >= 0)]
Share = Annotated[float, Bounds("0 to 1", lambda x: 0 <= x <= 1)]
Discount = Annotated[float, Bounds("between 0 and 1", lambda x: 0 < x < 1)]
Count = Annotated[int, Bounds("at least 1", lambda x: x >= 1)]
CountOrZero = Annotated[int, Bounds("at least 0", lambda x: x >= 0)]
AtLeastOne = Bounds("at least one", bool, of_each=False)
"""Of a tuple that may not be empty."""


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
def settings(cls: type[T]) -> type[T]:
    """A frozen dataclass whose values are checked whenever one is made.

    Values have to be numbers that arrays can hold, within the `Bounds` of their annotations. Then
    the method `check`, if there is one, looks at what joins several fields, and raises
    `ValueError`. Values that are refused raise `ConfigError`. A class variable `GONE` says of keys
    of earlier versions what became of them, for files that still have them.
    """

    def check_all(self: Any) -> None:
        for name, bounds, options in _bounds_of_fields(type(self)):
            value = getattr(self, name)
            if bounds.refuses(value):
                found = "none" if value == () else value
                raise ConfigError(f"{name}: expected {bounds.words}{options}, found {found}")
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            for x in value if isinstance(value, tuple) else (value,):
                if isinstance(x, float) and math.isnan(x):
                    expected = "finite numbers" if isinstance(value, tuple) else "a number"
                    raise ConfigError(f"{field.name}: expected {expected}, found {value}")
                if isinstance(x, int) and abs(x) > _LARGEST:
                    raise ConfigError(f"{field.name}: expected at most {_LARGEST}, found {x}")
        try:
            getattr(self, "check", lambda: None)()
        except ConfigError:
            raise
        except ValueError as error:
            raise ConfigError(str(error)) from error

    cls.__post_init__ = check_all  # pyright: ignore[reportAttributeAccessIssue]
    return dataclasses.dataclass(frozen=True)(cls)


@functools.cache
def _bounds_of_fields(cls: Any) -> list[tuple[str, Bounds, str]]:
    """Of each field that has some: name, bounds, and what may be chosen, if anything."""
    hints, found = get_type_hints(cls, include_extras=True), []
    for field in dataclasses.fields(cls):
        parts = list(_parts(hints[field.name]))
        options = ", ".join(part for part in parts if isinstance(part, str))
        options = f" of {options}" if options else ""
        found += [(field.name, part, options) for part in parts if isinstance(part, Bounds)]
    return found


def _parts(kind: Any) -> Iterator[Any]:
    """All that the annotation is made of."""
    for part in get_args(kind):
        yield part
        yield from _parts(part)


def default_config(name: str) -> Path:
    """The YAML file `name` (without ending; `folder/name` in a folder) that is shipped.

    An installed wheel carries the files in the package, a checkout beside it. An unknown name
    raises `ConfigError`.
    """
    for folder in _FOLDERS:
        path = folder / f"{name}.yaml"
        if path.is_file():
            return path
    inside, name = Path(name).parent, Path(name).name
    known = [path.stem for folder in _FOLDERS for path in sorted((folder / inside).glob("*.yaml"))]
    raise ConfigError(f"no configuration named {name!r}: expected {choices(name, known)}")


def find(path: str | Path) -> Path:
    """The YAML file at `path`, or the shipped one of that name: `ppo_small`.

    An unknown name raises `ConfigError`.
    """
    path = Path(path)
    return path if path.suffix or path.is_file() else default_config(str(path))


def load(cls: type[T], path: str | Path) -> T:
    """Read the YAML file at `path` into the dataclass `cls`.

    Keys that the file leaves out take the dataclass's defaults; within a nested dataclass, those of
    the default instance. A missing file, an unknown, repeated, missing or ill-typed key, or a value
    that the dataclass refuses raises `ConfigError`.
    """
    path = Path(path)
    try:
        tree = yaml.load(path.read_text(encoding="utf-8"), _Loader)
    except FileNotFoundError as error:
        beside = [file.name for file in sorted(path.parent.glob("*.y*ml"))]
        hint = f": expected {choices(path.name, beside)} in {path.parent}" if beside else ""
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
    elif origin is Literal:
        if (type(value), value) in [(type(option), option) for option in args]:
            return value
    elif origin is tuple and isinstance(value, list):
        kinds = args[:1] * len(value) if args[-1] is Ellipsis else args
        if len(kinds) == len(value):
            items = zip(value, kinds, strict=True)
            return tuple(_convert(x, kind, f"{field}[{i}]") for i, (x, kind) in enumerate(items))
    elif kind is float and type(value) is int:
        return float(value)
    elif kind is Path and isinstance(value, str):
        return Path(value)
    elif type(value) is kind:
        return value
    raise _mismatch(value, kind, field)


def _convert_dataclass(value: Any, cls: Any, field: str, base: Any = None) -> Any:
    """base: an instance whose values stand where the mapping has none; else those of the class."""
    if not isinstance(value, dict):
        raise _mismatch(value, cls, field)
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init}
    kinds, gone = get_type_hints(cls), getattr(cls, "GONE", {})
    converted = {}
    for key, item in value.items():
        place = _join(field, key)
        if key not in fields:
            said = gone.get(key) or f"unknown key, expected {choices(str(key), fields)}"
            shown = place if str(key).isprintable() else _join(field, repr(key))
            raise _MismatchError(f"{shown}: {said}")
        inner = getattr(base, key, fields[key].default)
        if isinstance(item, dict) and dataclasses.is_dataclass(inner):
            converted[key] = _convert_dataclass(item, type(inner), place, inner)
        else:
            converted[key] = _convert(item, kinds[key], place)
    for name, f in fields.items():
        no_default = f.default is f.default_factory is dataclasses.MISSING
        if base is None and no_default and name not in value:
            expected = _describe(kinds[name])
            raise _MismatchError(f"{_join(field, name)}: missing, expected {expected}")
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


def choices(name: str, known: Iterable[str]) -> str:
    """What may stand in the place of `name`, and what was likely meant, for messages."""
    known = list(known)
    return f"one of {', '.join(known) or '(none)'}{_hint(name, known)}"


def expect_fields(names: Iterable[str], *of: Any, where: str = "") -> None:
    """`ConfigError` for the first name that is a field of none of these dataclasses."""
    known = sorted({field.name for each in of for field in dataclasses.fields(each)})
    for name in names:
        if name not in known:
            raise ConfigError(f"{where}{name}: unknown setting, expected {choices(name, known)}")


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
