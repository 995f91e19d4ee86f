"""Errors that commands tell in one line."""


class UserError(Exception):
    """Something that a user can mend; the message names what was found, where, and the mend.

    The base of all such errors of this package.
    """


class TrainingInterrupted(Exception):
    """The user stopped the training; the message says where it was saved."""
