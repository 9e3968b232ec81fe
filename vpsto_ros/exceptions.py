"""Errors that this package raises on purpose; all of them derive from :class:`VpstoError`."""


class VpstoError(Exception):
    """Base of every error raised on purpose by this package."""


class InvalidInputError(VpstoError, ValueError):
    """An argument has the wrong shape, is not finite or is out of its domain."""


class InfeasibleError(VpstoError):
    """The problem is well posed but has no solution within the limits."""


class ConfigurationError(VpstoError, ValueError):
    """A parameter is unknown, of the wrong type or out of range; the message names what is allowed."""
