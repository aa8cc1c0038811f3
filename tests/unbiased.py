"""Whether independent estimates are unbiased, in standard errors of their mean."""

import numpy as np


def assert_unbiased(estimates, expected=1.0, loosest=np.inf, errors=4.0, slack=0.0):
    """The mean over runs, the leading axis, is within so many standard errors, in every entry.

    These are at most `loosest`: loose estimates would prove nothing.
    """
    estimates = np.asarray(estimates, float)
    error = estimates.std(axis=0, ddof=1) / np.sqrt(len(estimates))
    assert (error < loosest).all(), f"standard errors: {error}"
    gaps = estimates.mean(axis=0) - np.asarray(expected, float)
    assert (np.abs(gaps) <= errors * error + slack).all(), f"{gaps}, with errors of {error}"


def ratios_to(exact, found):
    """Ẑ/Z of every run, for an exact log Z, or an exact filter's answer."""
    log_z, exact = (getattr(run, "log_marginal_likelihood", run) for run in (found, exact))
    return np.exp(np.asarray(log_z, float) - float(exact))
