"""The errors a user of mrtm can cause; each message is one line: what, where, the value, and the mend."""


class MrtmError(Exception):
    """Base of every error that is the user's to mend."""


class ConfigError(MrtmError):
    """A configuration file, preset or option that does not make a configuration."""
