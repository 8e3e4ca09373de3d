"""What a diagnosis hands back."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import Solution
from imu_calibration.selection.gain import Gain


@dataclass(frozen=True, eq=False)
class Finding:
    """One effect that the model lacked."""

    effect: str
    """Published name."""
    sensor: str
    """'accelerometer', 'gyroscope' or 'reference'."""
    explanation: str
    """One sentence for a test engineer, with the size."""
    parameters: dict
    """Parameter name -> (value, sd, unit), SI, from all windows."""
    p_value: float
    """Chance of such a fall of the misfit by noise, times the number of effects asked about."""
    heldout_gain: float
    """Gain of log likelihood on held-out windows, nats."""
    share: float
    """Share of what was unexplained that it removes from held-out windows."""
    gain: Gain
    """`gain.Gain` on windows that took no part in choosing, of this finding on top of those before it."""
    indistinguishable_from: tuple
    """Effects that this recording cannot tell apart from it, at most two."""
    separating_motion: str
    """Which motion would tell them apart; empty when there is nothing to tell apart."""
    against: tuple = ()
    """What its residual is drawn against, as in ``Effect.against``."""
    sizes_of_mates: dict = field(default_factory=dict)
    """
    Each of `indistinguishable_from` -> parameter name -> (value, unit), SI: how large this recording would have it in the place of the
    finding.
    """
    implausible: bool = False
    """Whether its size is beyond what is known of any instrument: it is in no model then."""

    @property
    def title(self) -> str:
        """Its name, with the mark where its size is implausible."""
        return self.effect + ' (implausible)' * self.implausible


@dataclass(frozen=True, eq=False)
class Candidate:
    """One effect that was asked about."""

    effect: str
    """Published name."""
    sensor: str
    """'accelerometer', 'gyroscope' or 'reference'."""
    gain_alone: float
    """Gain of held-out log likelihood on top of the baseline, nats."""
    p_value_alone: float
    """Its p-value there, times the number of effects asked about."""
    gain_beside: float | None
    """The same on top of the findings; None for a finding."""
    p_value_beside: float | None
    """Its p-value there."""
    verdict: str
    """'found', 'as good as NAME', 'not needed beside the findings', 'no evidence', or why it was refused."""


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Everything that a report, a document and a node need."""

    findings: tuple
    """Findings as found, the strongest first."""
    unexplained: dict
    """Sensor -> `unexplained.Unexplained` beside the findings."""
    candidates: tuple
    """Every effect that was asked about, strongest first (Candidate)."""
    not_testable: tuple
    """{'effect', 'why', 'needs'} of the effects that could not be asked about."""
    baseline: Solution
    """Solution of the model that was diagnosed."""
    solution: Any
    """Solution of the extended model on all windows; the baseline's when nothing was found."""
    gain: Gain | None
    """`gain.Gain` of all findings together on windows that took no part in choosing; None where by hand nothing was found."""
    traces: Any
    """`gain.Traces`: residuals before and after, for plots."""
    windows: int
    """Windows used."""
    locked: int
    """Windows that took no part in choosing."""

    @property
    def model(self) -> SensorModel:
        """The extended SensorModel, linearised at the solution."""
        return self.solution.model.at(self.solution.values)


def parameters_of(solution: Solution, sensor: str, effect: str) -> dict[str, tuple[float, float, str]]:
    """Return parameter name -> (value, sd, unit) of one effect."""
    declared = next(e for e in solution.model.effects if (e.sensor, e.name) == (sensor, effect))
    part = solution.model.slices[sensor, effect]
    sd = np.sqrt(np.maximum(np.diag(solution.covariance)[part], 0.0))
    return {name: (float(value), float(spread), declared.unit_of(k))
            for k, (name, value, spread) in enumerate(zip(declared.param_names(), solution.values[part], sd))}
