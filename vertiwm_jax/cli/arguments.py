"""Reads command lines into frozen dataclasses, by tyro."""

import argparse
import dataclasses
import inspect
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from vertiwm_jax import config as configuration
from vertiwm_jax import xla
from vertiwm_jax.config import ConfigError

T = TypeVar("T")


def read(kind: Any, name: str, words: Sequence[str], **options: Any) -> Any:
    """Reads `words` into one of the dataclasses that `kind`, a type or a union, names.

    Bad input ends the process with status 2 and an error that names the option.
    """
    return tyro.cli(kind, args=words, prog=f"vertiwm {name}", **options)


def with_file(
    cls: type[T],
    default_file: str | Path,
    name: str,
    words: Sequence[str],
) -> T:
    """Read a command line: `[--config NAME or FILE] [--any.field VALUE] [--verbose]`.

    `--config` replaces `default_file`; a name is that of a file that the package ships. Every field
    can then be set by its dotted name, with dashes or underscores. Bad input ends the process with
    status 2 and an error that names the file or option.
    """
    first = argparse.ArgumentParser(prog=f"vertiwm {name}", add_help=False, allow_abbrev=False)
    first.add_argument("--config", type=Path, default=Path(default_file))
    asked = first.parse_known_args(words)[0].config
    try:
        file = configuration.find(asked)
        config = configuration.load(cls, file)
    except ConfigError as error:
        first.exit(2, f"{first.prog}: error: {error}\n")
    file_help = (
        "YAML file that gives the fields below their values, or the name of one that comes along."
    )
    verbose_help = "Say which options of the compiler are left out, as it does not know them."
    # tyro sees these as options like others, so that the help shows them.
    command_line = dataclasses.make_dataclass(
        "CommandLine",
        [
            ("config", Annotated[Path, tyro.conf.arg(help=file_help)], asked),
            ("verbose", Annotated[bool, tyro.conf.arg(help=verbose_help)], False),
            ("fields", tyro.conf.FlagConversionOff[Annotated[cls, tyro.conf.arg(name="")]], config),
        ],
    )
    try:
        given = read(
            command_line,
            name,
            words,
            description=inspect.getdoc(cls),
            config=(tyro.conf.AvoidSubcommands, tyro.conf.FlagCreatePairsOff),
        )
    except ValueError as error:  # tyro lets through what the outermost dataclass refuses
        first.exit(2, f"{first.prog}: error: {error}\n")
    if given.verbose:
        print(f"compiler options left out: {', '.join(xla.left_out()) or 'none'}", flush=True)
    return given.fields


def resumable(cls: type[T], file: str, name: str, words: Sequence[str]) -> T:
    """`with_file` with the shipped `file`, or with the configuration of the run to `--resume`.

    cls: has a field `resume`, the folder of a run, or None.
    """
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--resume", type=Path)
    resume = first.parse_known_args(words)[0].resume
    path = resume / "config.yaml" if resume else configuration.default_config(file)
    return with_file(cls, path, name, words)
