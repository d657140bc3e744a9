"""The one exception a user may see."""


class SlamError(Exception):
    """Something the user can mend: the message names the file, key or stage and the next step."""


class Damaged(SlamError):
    """A file of a run that is not what slamcli wrote: no part of a result may be left out on its account."""


class BadFrame(SlamError):
    """One frame of a recording that cannot be used; the caller skips it, warns and counts it."""
