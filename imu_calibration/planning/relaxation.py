"""
A lower bound on the time of every plan, by convex relaxation, with a certificate that can be checked by itself.

A plan visits motion k n_k times. It takes at least ``sum_k c_k n_k`` seconds (c_k the length of the motion) and gives at most the
information ``M_0 + sum_k n_k M_k`` (`belief.additive_bound`). So its time is at least the value of the semidefinite programme

    minimise c'y   such that   e_i' (M_0 + sum_k y_k M_k)^-1 e_i <= 1 for all i,  y >= 0,

in which motions may be visited a fraction of a time; e_i picks a parameter in units of its tolerance.

*Certificate.* For any vector x, ``e' M^-1 e >= 2 x'e - x'M x`` (complete the square). With vectors x_i and weights w_i >= 0, and
``X = sum_i w_i x_i x_i'`` so scaled that ``tr(M_k X) <= c_k`` for every k, each feasible y satisfies

    c'y >= sum_k y_k tr(M_k X) = tr(M X) - tr(M_0 X) >= sum_i w_i (2 x_i'e_i - 1) - tr(M_0 X).

The right-hand side is a bound for any w and x, without optimality. At the optimum it equals the value.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from imu_calibration.estimation.scaled_solve import inverse_normal

ROUNDS = 600
"""Steps of the multiplicative algorithm; the certificate is mostly within a few per cent after 200."""
LONGEST = 1e7
"""Tolerances that are not met after this time for every motion are out of reach, s."""
CLOSE = 1.01
"""The search ends when the relaxed value is within this factor of the certificate."""


@dataclass(frozen=True, eq=False)
class Relaxation:
    """The relaxed plan and its certificate."""

    seconds: float
    """Lower bound on the time of every plan, s."""
    visits: np.ndarray
    """How often the relaxed plan visits each motion, shape (k,)."""
    prices: np.ndarray
    """Matrix X: value of a unit of information, s, shape (n, n)."""
    relaxed_seconds: float
    """Time of the relaxed plan, s; the value of the programme lies between this and the bound."""
    weights: np.ndarray
    """How much each parameter limits the relaxed plan, sum 1, shape (p,)."""


def relax(information: np.ndarray, seconds: np.ndarray, known: np.ndarray, *, asked: np.ndarray, rounds: int = ROUNDS) -> Relaxation:
    """
    Return the relaxed plan with the best certificate found; NaN where a tolerance is out of reach.

    Visits and weights are improved by turns with multiplicative steps: visits of motions that are worth more than they cost grow (the
    algorithm of A-optimal design), and so do the weights of parameters with the largest excess over tolerance.

    Parameters
    ----------
    information : ndarray, shape (k, n, n)
        Most that one visit adds.
    seconds : ndarray, shape (k,)
        Cost.
    known : ndarray, shape (n, n)
        Information to start with.
    asked : ndarray, shape (p, n)
        Rows e_i: parameters in tolerances.

    """
    weights = np.full(len(asked), 1.0 / len(asked))
    if _worst(known, asked) <= 1.0:
        return Relaxation(0.0, np.zeros(len(seconds)), np.zeros_like(known), 0.0, weights)
    if _worst(known + LONGEST * np.sum(information / seconds[:, None, None], axis=0), asked) > 1.0:
        return Relaxation(np.nan, np.full(len(seconds), np.nan), np.full_like(known, np.nan), np.nan, weights)
    kept = np.arange(len(seconds))
    flat = information.reshape(len(seconds), -1)
    share = np.full(len(seconds), 1.0 / len(seconds)) / seconds
    best = Relaxation(0.0, np.zeros(len(seconds)), np.zeros_like(known), np.inf, weights)
    for number in range(rounds):
        total, scale = _scaled(np.tensordot(share[kept], flat[kept], 1).reshape(known.shape), known, asked)
        covariance = inverse_normal(total)   # nearly singular in unreachable directions
        x = covariance @ asked.T
        variance = np.einsum('pn,np->p', asked, x)
        prices = (x * weights) @ x.T
        worth = np.zeros(len(seconds))
        full = number % 25 == 0 or number == rounds - 1
        used = np.arange(len(seconds)) if full else kept
        worth[used] = flat[used] @ prices.ravel() / seconds[used]
        relaxed = scale * float(share @ seconds)
        if full:
            factor = 1.0 / worth.max()
            bound = factor * (weights @ (2 * variance - 1) - np.sum(known * prices))
            if bound > best.seconds:
                best = Relaxation(float(bound), scale * share, factor * prices, relaxed, weights)
            if relaxed < CLOSE * best.seconds:
                break
            kept = np.flatnonzero((worth > 0.3 * worth.max()) | (share * seconds > 1e-4 * (share @ seconds)))
        spent = share[kept] * seconds[kept]
        share[kept] *= np.sqrt(np.maximum(worth[kept], 1e-12) / (worth[kept] @ spent / spent.sum()))
        mask = np.zeros(len(share), bool)
        mask[kept] = True
        share = np.where(mask, share, 0.0 if number > 50 else share)
        weights = weights * variance / variance.max()
        weights /= weights.sum()
    return best


def _worst(information, asked):
    return float(np.einsum('pn,pn->p', asked @ np.linalg.inv(information), asked).max())


def _scaled(direction, known, asked):
    """Return the information with so much of `direction` that the worst parameter just meets its tolerance, and how much that is."""
    root = np.linalg.cholesky(known)
    inner = scipy.linalg.solve_triangular(root, scipy.linalg.solve_triangular(root, direction, lower=True).T, lower=True)
    values, vectors = scipy.linalg.eigh(0.5 * (inner + inner.T))
    squares = (scipy.linalg.solve_triangular(root, asked.T, lower=True).T @ vectors)**2
    low, high = -30.0, 60.0
    while high - low > 1e-4:
        middle = 0.5 * (low + high)
        enough = (squares / (1 + np.exp(middle) * np.maximum(values, 0.0))).sum(axis=1).max() <= 1.0
        low, high = (low, middle) if enough else (middle, high)
    return known + np.exp(high) * direction, float(np.exp(high))
