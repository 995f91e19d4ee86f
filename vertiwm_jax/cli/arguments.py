"""Reads command lines into frozen dataclasses, by tyro."""

import argparse
import inspect
from pathlib import Path
from typing import Any, TypeVar

import tyro

from vertiwm_jax import config as configuration
from vertiwm_jax import xla

T = TypeVar("T")
_CONFIG_HELP = """
--config NAME or FILE: YAML file that gives the fields below their values, or the name of
a shipped one. --verbose: say which compiler options the installed JAX does not know.
"""


def read(kind: Any, name: str, words: list[str], **options: Any) -> Any:
    """Reads `words` into one of the dataclasses of `kind`, or calls that with them if a function.

    Bad input ends the process with status 2 and an error that names the option.
    """
    return tyro.cli(kind, args=words, prog=f"vertiwm {name}", **options)


def with_file(cls: type[T], file: str | Path, name: str, words: list[str]) -> T:
    """Reads `[--config NAME or FILE] [--resume RUN] [--verbose] [--any.field VALUE]`.

    Values come from the YAML file `file`, or from the one that `--config` names, or from the
    configuration of the run to `--resume`; names are those of shipped files. Every field
    can then be set by its dotted name, with dashes or underscores. Bad input ends the process with
    status 2 and an error that names the file or option.
    """
    first = argparse.ArgumentParser(prog=f"vertiwm {name}", add_help=False, allow_abbrev=False)
    first.add_argument("--config", type=Path)
    first.add_argument("--resume", type=Path)
    first.add_argument("--verbose", action="store_true")
    asked, fields = first.parse_known_args(words)
    if asked.resume:
        file = asked.resume / "config.yaml"
        fields += ["--resume", str(asked.resume)]
    if asked.verbose:
        print(f"compiler options left out: {', '.join(xla.left_out()) or 'none'}", flush=True)
    try:
        return read(
            cls,
            name,
            fields,
            default=configuration.load(cls, configuration.find(asked.config or file)),
            description=f"{inspect.getdoc(cls)}\n{_CONFIG_HELP}",
            config=(tyro.conf.AvoidSubcommands, tyro.conf.FlagConversionOff),
        )
    except ValueError as error:  # of the file, or what the outermost dataclass refuses
        first.exit(2, f"{first.prog}: error: {error}\n")
