"""The errors a user of mrtm can cause; each message is one line: what, where, the value, and the mend."""


class MrtmError(Exception):
    """Base of every error that is the user's to mend."""


class OutputError(MrtmError):
    """A place that cannot be written to, or where something would be lost."""


class ConfigError(MrtmError):
    """A configuration file, preset or option that does not make a configuration."""
