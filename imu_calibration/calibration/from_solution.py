"""The document from a solution, and changes of the model that it reports."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
from typing import Any, TypeVar, cast

import numpy as np

import imu_calibration
from imu_calibration.calibration.gathered_data import GatheredData
from imu_calibration.calibration.options import CalibrationOptions
from imu_calibration.core.readings import RawReadings
from imu_calibration.document.calibration import Calibration
from imu_calibration.document.proof_entry import Proof
from imu_calibration.document.statistics import SensorEntry
from imu_calibration.document.trust import Uncorrected
from imu_calibration.document.verdict import judged
from imu_calibration.effects.forward_equations import centred
from imu_calibration.estimation.sensor_noise import SensorNoise
from imu_calibration.estimation.solution import (
    REJECTED,
    Solution,
    reasons_held,
    statuses,
    with_term,
)
from imu_calibration.preprocessing.checks import unusable, visible_findings

Estimate = TypeVar('Estimate', bound=Solution)
"""Solution of a reference."""


@dataclass(frozen=True)
class ModelChanges:
    """Names of effects, the strongest first, and the residual that none of them explains."""

    added: tuple[str, ...] = ()
    """Added to the model because the data support them."""
    unstable: tuple[str, ...] = ()
    """
    Not added because the estimates of parts of the recording differ; the standard deviations allow
    for them.
    """
    implausible: dict[str, float] = field(default_factory=dict)
    """
    Not added because no known instrument has effects of this size -> explained share of the excess
    variance; the standard deviations allow for them.
    """
    lacking: tuple[str, ...] = ()
    """
    Demanded, but the motion of before is no longer kept, so that they cannot join; the standard
    deviations allow for them.
    """
    unexplained: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Sensor -> rms and axes of its unexplained residual, by the test of `diagnose`."""
    stamp_jitter: dict[str, Any] = field(default_factory=dict)
    """
    Sd of independent errors of the stamps and the variance ratios they cause (`StampJitter`), empty
    where not significant.
    """
    changed_at: float | None = None
    """
    Time of a change of parameters at one moment (`find_onset`), s: effects and residual are of the
    longer part.
    """

    def to_mapping(self) -> dict:
        """Return the entries of a document's statistics: the fields that are not empty."""
        entries = {}
        for name, value in vars(self).items():
            if not value:
                continue
            key = 'denied' if name == 'unstable' else name
            entries[key] = list(value) if isinstance(value, tuple) else value
        return entries


@dataclass(frozen=True, eq=False)
class ModelExtension:
    """
    Effects that a recording supports, as needed for further solutions of the same and more windows.
    """

    added: tuple[tuple[str, str], ...] = ()
    """(sensor, effect) in addition to the requested ones."""
    point: dict[str, np.ndarray] = field(default_factory=dict)
    """Effect -> values of the first linearisation."""
    changes: ModelChanges = ModelChanges()
    """Names of effects, and residuals, for the document."""
    moves: tuple[tuple[Mapping[str, float], float], ...] = ()
    """(parameter -> its change under another choice of effects, weight of that choice)."""
    clipped: Solution | None = None
    """The solution without saturated samples if the search found a limit of a sensor."""

    def options(self, requested: CalibrationOptions) -> CalibrationOptions:
        """Return the options of the requested model with the added effects."""
        return replace(requested, added=self.added, point=self.point)

    def disagreement(self, names: Sequence[str]) -> np.ndarray:
        """
        Return the covariance of parameters due to other choices of effects, (n_params, n_params).

        With the change d of the parameters and the weight w of each choice: ``sum w d d'``.
        """
        covariance = np.zeros((len(names),) * 2)
        for change_of, weight in self.moves:
            change = np.array([change_of.get(name, 0.0) for name in names])
            covariance += weight * np.outer(change, change)
        return covariance

    def applied(self, solution: Estimate) -> Estimate:
        """
        Return a solution with the covariance of other choices of effects as a term.

        If the search found a limit of a sensor, its solution without clipped samples is used.
        """
        # A clipped solution is of the same reference.
        used = cast('Estimate', self.clipped or solution)
        disagreement = self.disagreement(used.param_names)
        return replace(used, terms=with_term(used.terms, REJECTED, disagreement))

    @property
    def is_nothing(self) -> bool:
        """Whether the solution of the requested model and its notes are unchanged."""
        return not (self.added or self.moves or self.clipped or self.changes != ModelChanges())


def document(
    solution: Solution,
    tolerances: np.ndarray,
    gathered: GatheredData,
    *,
    gravity: float,
    gauge: dict,
    undetermined: tuple[dict, ...],
    statistics: dict,
    provenance: dict | None,
    proof: Proof,
    changes: ModelChanges,
    uncorrected: Uncorrected,
    tested: Collection[str],
    absent: tuple[str, ...],
    readings: RawReadings | None,
) -> Calibration:
    """
    Return the Calibration for a solution, with statuses and the verdict.

    Parameters
    ----------
    solution : Solution
    tolerances : ndarray, shape (n_params,)
    gathered : GatheredData
        Data of the recording.
    gravity : float
        Of the reference, m/s^2.
    gauge, undetermined, statistics, provenance, proof
        Parts of the document.
    changes : ModelChanges
    uncorrected : Uncorrected
        Effects in time that compensation does not correct; their centres are included in the
        values.
    tested : names
        Parameters that are replaced by a likelihood-ratio test.
    absent : sensors
        Sensors without readings.
    readings : RawReadings or None
        Units and axes of the recording; None: SI, axes not stated.

    """
    # Effects in time that compensation replaces by a constant are centred: values v become
    # functions of v with the derivative `slope`.
    model = solution.model.at(solution.values)
    values, slope = centred(model, solution.values, uncorrected.centre)
    terms = {name: slope @ term @ slope.T for name, term in solution.terms.items()}
    centred_solution = replace(solution, values=values, terms=terms)

    all_statistics = {
        **statistics,
        'preflight': [finding.to_mapping() for finding in visible_findings(gathered.findings)],
        'unusable': unusable(gathered.findings),
        **changes.to_mapping(),
        **uncorrected.to_mapping(),
    }
    calibration = Calibration(
        model=replace(model, centre=dict(uncorrected.centre)),
        values=values,
        covariance=centred_solution.covariance,
        status=statuses(centred_solution.judged_sd, centred_solution.held, tolerances),
        frame_id=gathered.frame_id,
        gauge=gauge,
        undetermined=undetermined,
        statistics=all_statistics,
        conditions=conditions(gathered, gravity),
        provenance={'software': imu_calibration.__version__, **(provenance or {})},
        proof=proof,
        covariance_terms={name: np.diag(term) for name, term in terms.items()},
        held_reason=reasons_held(
            solution.held, solution.param_names, solution.replaced, tested=tested
        ),
        absent=absent,
        readings=readings or RawReadings(),
    )
    return judged(calibration, tolerances)


def noise_entry(noise: SensorNoise) -> SensorEntry:
    """Return the statistics of the noise of one sensor and of the scatter of its means."""
    return SensorEntry(
        noise_sd=noise.white_sd,
        between_window_sd=noise.offset_sd,
        wander_sd=float(np.sqrt(noise.bias_variance)),
    )


def conditions(gathered: GatheredData, gravity: float) -> dict:
    """Return the section `conditions` of the document; `gravity` in m/s^2."""
    first_second = (gathered.first_stamp_ns or 0) // 10**9
    date = datetime.fromtimestamp(first_second, timezone.utc)
    return {
        'temperature_range_c': gathered.temperature_c,
        'largest_rate': gathered.largest_rate,
        'largest_force': gathered.largest_force,
        'gravity': gravity,
        'duration_s': gathered.duration,
        'date': date.strftime('%Y-%m-%dT%H:%M:%SZ'),
    }
