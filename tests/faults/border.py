"""What tests of faults share."""

from collections.abc import Callable
from typing import TypeVar

import pytest

Value = TypeVar("Value")


class Escaped(Exception):
    """What reads a file ended otherwise than in its own error of one line."""


def fault(raises: type[BaseException], reason: str) -> pytest.MarkDecorator:
    """The mark of a test that fails today; whoever mends the fault takes it away."""
    return pytest.mark.xfail(strict=True, raises=raises, reason=reason)


def outcome(
    read: Callable[[], Value], error: type[Exception]
) -> tuple[Value, None] | tuple[None, str]:
    """What `read` gives, or else the one line of its `error`; anything else is `Escaped`."""
    try:
        return read(), None
    except error as refused:
        if "\n" in str(refused):
            raise Escaped(f"expected one line, found {refused}") from refused
        return None, str(refused)
    except Exception as other:
        raise Escaped(f"expected {error.__name__}, found {other!r}") from other


def refusal(read: Callable[[], object], error: type[Exception]) -> str:
    """The one line that `read` is refused by; empty where it is not."""
    return outcome(read, error)[1] or ""
