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
    Return for each sensor its errors on held-out data before and after, and by regime.

    Before: with nominal parameters of the sensor. After: with the parameters without each fold. On
    each side the smaller error counts of the reference as it was estimated and as it was described.
    """
    proof = {}
    for sensor, judged in held_out.judged.items():
        before = smallest_errors(held_out, sensor, held_out.nominal(sensor, held_out.folds))
        after = smallest_errors(held_out, sensor, held_out.folds)
        proof[sensor] = proof_entry(judged, before, after)
    return proof


def smallest_errors(
    held_out: HeldOutData[Any], sensor: str, folds: Sequence[np.ndarray]
) -> HeldOutErrors:
    """Return the errors of a sensor with the description of the reference that suits it best."""
    return smallest(held_out.errors(sensor, each) for each in held_out.descriptions(folds))


def smallest(candidates: Iterable[HeldOutErrors]) -> HeldOutErrors:
    """Return the errors with the smallest sum of squares."""
    return min(candidates, key=lambda errors: errors.squares.sum())


def proof_entry(judged: JudgedData, before: HeldOutErrors, after: HeldOutErrors) -> ProofEntry:
    """Return the errors of one sensor in all motions, and by regime with enough blocks."""
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
    """Return the entry of errors before and after, shape (n, components), of `seconds` of data."""
    n, components = before.shape
    judged = JudgedData(np.ones((n, 1)), unit, n, components)
    return replace(
        proof_entry(judged, errors_of_rows(before), errors_of_rows(after)), seconds=seconds
    )


def _compared(
    judged: JudgedData, before: np.ndarray, after: np.ndarray, counts: np.ndarray
) -> RegimeErrors:
    """
    Return the rms errors per component, and the interval of their ratio.

    The interval is over resamples of complete blocks.

    Parameters
    ----------
    judged : JudgedData
    before, after : array, shape (n_blocks,)
        Sums of squared errors.
    counts : array, shape (n_blocks,)
        Number of errors in each sum, per component.

    """
    held = counts > 0
    before = before[held]
    after = after[held]
    counts = counts[held]
    draw = np.random.default_rng(1).integers(0, len(counts), (BLOCK_RESAMPLES, len(counts)))
    with np.errstate(divide='ignore', invalid='ignore'):
        ratio = np.sqrt(after[draw].sum(axis=1) / before[draw].sum(axis=1))
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
