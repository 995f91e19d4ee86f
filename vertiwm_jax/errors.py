"""Errors that commands print in one line."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager


class UserError(Exception):
    """An error that a user can correct; the message says what was found, where, and what to do.

    Base class of all such errors of this package.
    """


class TrainingInterrupted(Exception):
    """The user stopped the training; the message says where it was saved."""


@contextmanager
def needs(package: str, extra: str, what: object) -> Iterator[None]:
    """Raises `UserError` where an import in the context fails: how to get the optional package.

    extra: of this package, which installs it. what: the file that it is needed for.
    """
    try:
        yield
    except ImportError as error:
        raise UserError(
            f"{what}: expected the package {package}, found: {error}; "
            f'pip install "vertiwm-jax[{extra}]"'
        ) from None


@contextmanager
def refusing(refusal: Callable[[str], UserError]) -> Iterator[None]:
    """Raises `refusal(found)` where a damaged file causes an error; found: what that says.

    A `UserError` passes as it is.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        raise refusal(" ".join(f"{type(error).__name__}: {error}".split())) from error
