"""Does a calibration help on held-out data? Errors before and after, for any reference."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from imu_calibration.calibration.held_out_data import (
    HeldOutData,
    HeldOutErrors,
    JudgedData,
    errors_of_rows,
)
from imu_calibration.document.proof_entry import Proof, ProofEntry, RegimeErrors

BLOCK_RESAMPLES = 1000
"""Resamples of complete blocks for an interval."""
MIN_REGIME_BLOCKS = 3
"""Least blocks for a result in a regime."""


def prove(held_out: HeldOutData[Any]) -> Proof:
    """
    Return sensor -> its rms error on held-out data before and after the calibration, by regime.

    Each fold of the data is predicted with parameters estimated without it ("after"), and with the
    nominal parameters of the sensor in their place ("before").
    """
    proof = {}
    for sensor, judged in held_out.judged.items():
        nominal_folds = held_out.nominal(sensor, held_out.folds)
        before = smallest_errors(held_out, sensor, nominal_folds)
        after = smallest_errors(held_out, sensor, held_out.folds)
        proof[sensor] = proof_entry(judged, before, after)
    return proof


def smallest_errors(
    held_out: HeldOutData[Any], sensor: str, folds: Sequence[np.ndarray]
) -> HeldOutErrors:
    """
    Return the errors of a sensor with the parameters `folds` of each fold, each shape (n_params,).

    The parameters of the reference are those estimated or those described, of which the ones with
    the smaller error count.
    """
    candidates = []
    for described_folds in held_out.descriptions(folds):
        candidates.append(held_out.errors(sensor, described_folds))
    return smallest(candidates)


def smallest(candidates: Iterable[HeldOutErrors]) -> HeldOutErrors:
    """Return the errors with the smallest sum of squares."""
    return min(candidates, key=lambda errors: errors.squares.sum())


def proof_entry(judged: JudgedData, before: HeldOutErrors, after: HeldOutErrors) -> ProofEntry:
    """
    Return the rms errors of one sensor in total, and in each regime with enough blocks.

    With an estimated delay, the share of the squared error that it explains is given as well.
    """
    regimes = {}
    for k, name in enumerate(judged.regimes):
        counts = judged.counts[:, k]
        if (counts > 0).sum() >= MIN_REGIME_BLOCKS:
            regimes[str(name)] = _compared(
                judged, before.squares[:, k], after.squares[:, k], counts
            )
    in_total = _compared(
        judged, before.squares.sum(axis=1), after.squares.sum(axis=1), judged.counts.sum(axis=1)
    )
    explained = None
    if after.without_delay is not None:
        explained = float(1.0 - after.squares.sum() / max(after.without_delay, 1e-300))
    return ProofEntry(
        **vars(replace(in_total, windows=judged.windows)),
        delay_s=after.delay,
        delay_explains=explained,
        regimes=regimes,
        one_attitude=judged.one_attitude,
        few_directions=judged.few_directions,
    )


def entry_of(
    unit: str, before: np.ndarray, after: np.ndarray, *, seconds: float | None = None
) -> ProofEntry:
    """
    Return the entry of errors before and after, each of shape (n, components).

    Errors of different rows are independent. `seconds`: length of the data.
    """
    n, components = before.shape
    judged = JudgedData(counts=np.ones((n, 1)), unit=unit, windows=n, components=components)
    entry = proof_entry(judged, errors_of_rows(before), errors_of_rows(after))
    return replace(entry, seconds=seconds)


def _compared(
    judged: JudgedData, before: np.ndarray, after: np.ndarray, counts: np.ndarray
) -> RegimeErrors:
    """
    Return the rms errors per component, and the 95 % interval of their ratio.

    The interval is that of resamples of complete blocks (bootstrap).

    Parameters
    ----------
    judged : JudgedData
    before, after : array, shape (n_blocks,)
        Sums of squared errors.
    counts : array, shape (n_blocks,)
        Number of errors in each sum, per component.

    """
    has_errors = counts > 0
    before = before[has_errors]
    after = after[has_errors]
    counts = counts[has_errors]

    # Ratio of the errors in each resample of the blocks.
    drawn = np.random.default_rng(1).integers(0, len(counts), (BLOCK_RESAMPLES, len(counts)))
    with np.errstate(divide='ignore', invalid='ignore'):
        ratio = np.sqrt(after[drawn].sum(axis=1) / before[drawn].sum(axis=1))
    # A ratio of two zeros counts as no change, that to a zero before as very large.
    low, high = np.nan_to_num(np.quantile(ratio, (0.025, 0.975)), nan=1.0, posinf=1e9)
    n_errors = judged.components * counts.sum()
    seconds = None
    if judged.piece_time is not None:
        seconds = float(counts.sum() * judged.piece_time)
    return RegimeErrors(
        before=float(np.sqrt(before.sum() / n_errors)),
        after=float(np.sqrt(after.sum() / n_errors)),
        ci95=(float(low), float(high)),
        seconds=seconds,
        unit=judged.unit,
    )
