"""The covariance of an estimate as named terms whose sum is the total, and weak parameters that are replaced by their prior."""

from collections.abc import Mapping, Sequence

import numpy as np

Terms = Mapping[str, np.ndarray]
"""Term -> covariance matrix, shape (n_params, n_params)."""
SAMPLE_NOISE = 'noise'
"""White noise of the samples and of the reference."""
BIAS_PROCESS = 'bias_process'
"""Bias processes, offsets of windows or poses, and the bias of each recording."""
HELD_PRIORS = 'held_parameters'
"""The uncertainty of priors at which parameters are fixed, and the squared shift of replaced parameters."""
MODEL_ERROR = 'model_error'
"""Scatter between parts of the recording beyond noise."""
DRIFT = 'drift'
"""Parameters that change during the recording."""
REJECTED = 'rejected_effects'
"""Effects that were rejected, or are collinear with other effects in the recording."""
GRAVITY = 'gravity'
"""The uncertainty of the local gravity."""
UNMODELLED_EARTH_RATE = 'earth_rate'
"""The Earth's rate, where it is not modelled."""


def total(terms: Terms) -> np.ndarray:
    """Return the covariance, the sum of its terms."""
    return np.sum(list(terms.values()), axis=0)


def with_term(terms: Terms, name: str, covariance: np.ndarray) -> dict[str, np.ndarray]:
    """Return the terms with a covariance added to one of them."""
    return {**terms, name: terms.get(name, 0.0) + covariance}


def of_fit(terms: Terms) -> np.ndarray:
    """Return the posterior covariance of the fit, without allowances: noise and bias processes."""
    return total({name: terms[name] for name in (SAMPLE_NOISE, BIAS_PROCESS) if name in terms})


def replace_weak(values: np.ndarray, terms: Terms, prior: np.ndarray, *,
                 weak: Sequence[int], limit: np.ndarray | float = 1.0) -> tuple[np.ndarray, dict[str, np.ndarray], np.ndarray]:
    """
    Return (values, terms, mask of the replaced parameters) with weak values replaced by their prior where that lowers the expected error.

    A value v with prior p and standard deviation s of the fit is replaced where ``(v - p)^2 < s^2``. The parameter with the smallest ratio
    is replaced first; all parameters correlated with it are updated with it fixed, ``x += C[:, k] / C[k, k] (p - v)``, C being the
    posterior covariance of the fit, before the next test. The error of the result is that of the estimate and the shift d, so that
    its covariance is the former one plus ``d d'``: at most ``1 + limit`` times the former variance. The variance of the prior itself
    would ignore the recording, which bounds the parameter much more closely.

    Parameters
    ----------
    values : ndarray, shape (n_params,)
    terms : mapping
        Covariance of the values.
    prior : ndarray, shape (n_params,)
        Prior values; a parameter whose prior is not finite is not replaced.
    weak : sequence of int
        Parameters under test.
    limit : array of shape (n_params,) or float
        Largest ``(v - p)^2 / s^2`` of a replaced parameter: 1 for the smallest expected error without knowledge of the truth; the quantile
        of chi-square for a likelihood-ratio test of the prior value.

    """
    moved, posterior, limits = values.copy(), of_fit(terms), np.broadcast_to(limit, values.shape)
    replaced, smallest = np.zeros(len(values), bool), 1e-12 * np.diag(posterior)
    candidates = [k for k in weak if np.isfinite(prior[k])]
    while candidates := [k for k in candidates if posterior[k, k] > smallest[k]]:
        ratio = [(moved[k] - prior[k])**2 / posterior[k, k] / limits[k] for k in candidates]
        least = int(np.argmin(ratio))
        if ratio[least] >= 1.0:
            break
        k = candidates.pop(least)
        slope = posterior[:, k] / posterior[k, k]
        moved, posterior = moved + slope * (prior[k] - moved[k]), posterior - np.outer(slope, posterior[k])
        replaced[k] = True
    moved[replaced] = prior[replaced]
    if not replaced.any():
        return values, dict(terms), replaced
    return moved, with_term(terms, HELD_PRIORS, np.outer(moved - values, moved - values)), replaced
