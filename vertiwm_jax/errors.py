"""The base of all errors that a user can mend; commands tell them in one line."""


class UserError(Exception):
    """Something that a user can mend; the message names what was found, where, and the mend."""
