"""Errors that are meant for people."""


class UserError(Exception):
    """Something a user asked for can't be done.

    The message is one line: what was wrong, where, and what would be right. Commands print it and exit with status 2.
    """
