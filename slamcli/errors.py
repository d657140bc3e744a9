"""The one exception a user may see."""


class SlamError(Exception):
    """Something the user can mend: the message names the file, key or stage and the next step."""


class BadFrame(SlamError):
    """One frame of a recording that cannot be used; the caller skips it, warns and counts it."""
