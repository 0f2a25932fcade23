"""What can go wrong in the front end through no fault of the program."""


class FrontendError(Exception):
    """Base of every error a user of the front end can cause; its message is one line that says what to mend."""


class LogError(FrontendError):
    """A log that cannot be read: missing, empty, of no known format, or without a usable scan."""
