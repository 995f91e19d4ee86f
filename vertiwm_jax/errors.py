"""Errors that commands print in one line."""


class UserError(Exception):
    """An error that a user can correct; the message says what was found, where, and what to do.

    Base class of all such errors of this package.
    """


class TrainingInterrupted(Exception):
    """The user stopped the training; the message says where it was saved."""


def one_line(error: Exception) -> str:
    """What an error of another package says, and its kind, on one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())
