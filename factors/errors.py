"""The one exception of this package."""


class FactorError(ValueError):
    """A measurement, covariance or edge that cannot become a factor: which, why, and the value."""
