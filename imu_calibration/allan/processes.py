"""
The noise processes that an Allan curve is made of, each declared once.

A process is known by the generalised covariance ``G(t)`` of its integral: second differences of the integral are all that an Allan variance
sees, and their covariance is a fourth difference of G. Coefficients enter G linearly (the squares N^2, K^2, ...).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.special import factorial

SMALL = 1.0
"""Below this argument the Gauss-Markov kernel is summed as a series: its leading terms cancel in fourth differences."""
SERIES = 1.0 / factorial(np.arange(20, 2, -1))
"""Coefficients of ``exp(u) - 1 - u - u^2 / 2``, the highest first, without the factor u^3."""


@dataclass(frozen=True, eq=False)
class NoiseProcess:
    """One process of unit coefficient."""

    name: str
    """Name in noise.yaml."""
    symbol: str
    """The usual letter."""
    unit: str
    """Factor after the sensor's unit."""
    kernel: Callable[[np.ndarray], np.ndarray]
    """Generalised covariance of the integral at lags in s; even, known up to even polynomials of degree two."""
    explanation: str
    """One sentence."""
    lattice: bool = False
    """Whether the kernel lives on the sampling instants only (a spike at zero)."""
    time: float = 0.0
    """Correlation time, s."""


def allan_variance(process: NoiseProcess, tau: np.ndarray) -> np.ndarray:
    """Return the Allan variance of a process of unit coefficient: ``(3 G(0) - 4 G(tau) + G(2 tau)) / tau^2``."""
    tau = np.asarray(tau, float)
    return (3 * process.kernel(0.0 * tau) - 4 * process.kernel(tau) + process.kernel(2 * tau)) / tau**2


def mean_covariance(process: NoiseProcess, lag: np.ndarray, seconds: float) -> np.ndarray:
    """
    Return the generalised covariance of means over `seconds` whose beginnings are `lag` s apart.

    For processes without a variance (random walk, flicker) it holds for combinations whose weights sum to zero.
    """
    lag = np.asarray(lag, float)
    return (2 * process.kernel(lag) - process.kernel(lag + seconds) - process.kernel(lag - seconds)) / seconds**2


def _quantisation(lag):
    return (np.abs(lag) < 1e-12).astype(float)


def _white(lag):
    return -0.5 * np.abs(lag)


def _flicker(lag):
    lag = np.abs(lag)
    return lag**2 * np.log(np.maximum(lag, 1e-300)) / (2 * np.pi)


def _random_walk(lag):
    return np.abs(lag)**3 / 12


QUANTISATION = NoiseProcess('quantisation', 'Q', 's', _quantisation, 'The output has discrete steps: variance 3 Q^2 / tau^2.',
                            lattice=True)
WHITE = NoiseProcess('white_noise', 'N', '/sqrt(Hz)', _white, 'Every sample errs by itself: variance N^2 / tau.')
FLICKER = NoiseProcess('bias_instability', 'B', '', _flicker,
                       'The bias has noise of density B^2 / (2 pi f): variance (2 ln 2 / pi) B^2 at every tau.')
RANDOM_WALK = NoiseProcess('random_walk', 'K', '/s/sqrt(Hz)', _random_walk, 'The bias walks at random: variance K^2 tau / 3.')


@lru_cache(maxsize=512)
def gauss_markov(time: float) -> NoiseProcess:
    """Return the first-order Gauss-Markov process of unit variance and correlation time `time`, s."""
    def kernel(lag):
        u = np.abs(lag) / time
        values = np.expm1(-u) + u - 0.5 * u**2
        small = u < SMALL
        values[small] = -u[small]**3 * np.polyval(SERIES, -u[small])
        return -time**2 * values
    return NoiseProcess('gauss_markov', 'sigma', '', kernel, f'The bias wanders and forgets within {time:g} s.', time=time)


FLATNESS = (2 * np.log(2) / np.pi)**0.5
"""Deviation of flicker noise over B: 0.664."""
