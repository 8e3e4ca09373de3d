"""Decision per sensor, and the statements in which it is printed."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from imu_calibration.core.errors import with_hint
from imu_calibration.core.text_enum import StrEnum
from imu_calibration.core.units import error_text
from imu_calibration.document.proof_entry import ProofEntry, RegimeErrors
from imu_calibration.effects.base import SENSORS

HARM = 1.05
"""Factor on the error of a regime from which it is named, where the interval lies above 1 too."""
MIN_NAMED_DELAY = 1e-3
"""Delays from this size on are named as a cause, s."""
REST_SHARE = 0.7
"""An error at rest of at least this share of the total is attributed to the bias."""
DELAY_SHARE = 0.1
"""A delay is named as a cause where it explains this share of the residual."""
OTHER_ATTITUDES = (
    '; unproven for other attitudes, because all held-out windows have the same attitude'
)
FEW_DIRECTIONS = (
    '; unproven for other attitudes, because all held-out rests lie near the axes of the sensor,'
    ' where cross terms have no effect'
)
NO_PROOF = 'its error on held-out data was not measured'


class SensorDecision(StrEnum):
    """Whether the calibration of a sensor helps; stored as text in a document."""

    HELPS = 'helps'
    """The 95 % interval of error after / error before lies below 1."""
    UNPROVEN = 'unproven'
    """
    The interval includes 1, there is none, or the held-out windows of the accelerometer have one
    attitude or lie near the axes of the sensor.
    """
    HARMS = 'harms'
    """The interval lies above 1."""


HELPS, UNPROVEN, HARMS = SensorDecision
BY_DEFINITION: dict[str, Any] = {
    'decision': dict.fromkeys(SENSORS, str(HELPS)),
    'decision_reasons': dict.fromkeys(SENSORS, 'the true parameters of a simulation'),
}
"""Fields of the Calibration with which a session was simulated."""


def same_directions(entry: ProofEntry) -> str:
    """Return why other attitudes are unproven, from an entry of a proof; '' where they are not."""
    if entry.one_attitude:
        return OTHER_ATTITUDES
    return FEW_DIRECTIONS if entry.few_directions else ''


def decide(entry: ProofEntry | None) -> SensorDecision:
    """Return the decision on a sensor from its entry of a proof (`proof.prove`), or from None."""
    if entry is None or not entry.windows or same_directions(entry):
        return UNPROVEN
    low, high = entry.ci95
    if high < 1.0:
        return HELPS
    return HARMS if low > 1.0 else UNPROVEN


def most_cautious(decisions: Iterable[SensorDecision]) -> SensorDecision:
    """Return the worst of several decisions; HELPS without any."""
    return max(decisions, key=list(SensorDecision).index, default=HELPS)


def decisions_text(decisions: Mapping[str, SensorDecision]) -> str:
    """Return the decisions on the sensors in one phrase; '' without any."""
    distinct = set(decisions.values())
    if len(distinct) == 1:
        return str(*distinct)
    return ', '.join(f'{sensor} {decision}' for sensor, decision in decisions.items())


def reason_of(entry: ProofEntry | None) -> str:
    """
    Return the reason for the decision of `decide`.

    It has the errors before and after, the interval of their ratio, and the regimes with a larger
    error if the calibration helps, or the likely cause if it does not.
    """
    if entry is None or not entry.windows:
        return NO_PROOF
    comparison = ''
    if entry.earlier is not None:
        error = error_text(entry.earlier.after, entry.unit)
        comparison = f', {error} with the earlier calibration'
    restriction = same_directions(entry)
    if not restriction:
        restriction = _exceptions(entry) if decide(entry) is HELPS else _cause(entry)
    return (
        f'{_errors(entry)} on held-out data ({entry.windows} windows, after /'
        f' before {ratio_text(entry)}){comparison}{restriction}'
    )


def worse_regimes(entry: ProofEntry) -> list[str]:
    """Return a line for each regime in which the error grows."""
    lines = []
    for name, part in harmed(entry).items():
        lines.append(
            f'{_errors(part)} on held-out data of the regime {name}'
            f' (after / before {ratio_text(part)})'
        )
    return lines


def harmed(entry: ProofEntry) -> dict[str, RegimeErrors]:
    """Return the regimes of a proof in which the error grows, with their errors."""
    regimes = {}
    for name, errors in entry.regimes.items():
        if errors.after > HARM * errors.before and errors.ci95[0] > 1.0:
            regimes[name] = errors
    return regimes


def _exceptions(entry: ProofEntry) -> str:
    """Return the regimes in which a sensor that is helped gets worse, as the end of a sentence."""
    names = ', '.join(str(name) for name in harmed(entry))
    return f'; but it grows in the regime {names}' if names else ''


def _errors(entry: RegimeErrors) -> str:
    """Return the errors before and after compensation as a phrase."""
    before = error_text(entry.before, entry.unit)
    after = error_text(entry.after, entry.unit)
    return f'error {before} to {after}'


def ratio_text(entry: RegimeErrors) -> str:
    """Return the interval of error after / error before as it is printed everywhere."""
    low, high = entry.ci95
    return f'{low:.2g} to {high:.2g}'


def _cause(entry: ProofEntry) -> str:
    """Return the most likely cause as the end of a sentence."""
    delay = entry.delay_s or 0.0
    share = entry.delay_explains or 0.0
    if abs(delay) > MIN_NAMED_DELAY and share > DELAY_SHARE:
        side = 'late' if delay > 0 else 'early'
        return (
            f'; likely cause: the readings are {abs(delay) * 1e3:.0f} ms {side}, which the model'
            ' does not include'
        )
    rest = entry.regimes.get('rest')
    error_at_rest = 0.0
    if rest is not None and rest.unit == entry.unit:
        error_at_rest = rest.after
    if 'rest' in harmed(entry) or error_at_rest > REST_SHARE * entry.after > 0.0:
        return '; likely cause: the bias has changed'
    if entry.regimes and set(harmed(entry)) == {'angular acceleration'}:
        return (
            '; likely cause: the error correlates with angular acceleration: a lever arm, a varying'
            ' lag, a loose mount'
        )
    if entry.after < HARM * entry.before:
        return (
            '; likely cause: the error is close to the smallest that this recording can show, or'
            ' the parameters change during it'
        )
    return (
        '; likely cause: parameters that this motion hardly determines are biased by an effect that'
        ' the model does not include'
    )


class StatementKind(StrEnum):
    """Kind of a statement."""

    DECISION = 'decision'
    """The decision on a sensor."""
    PARAMETERS = 'parameters'
    """How many parameters are within their tolerance, or which are not."""
    WARNING = 'warning'
    """A finding that the user should follow up."""
    NOTE = 'note'
    """A remark."""


DECISION, PARAMETERS, WARNING, NOTE = StatementKind


@dataclass(frozen=True)
class Reason:
    """One statement about the calibration."""

    word: StatementKind
    """Its kind."""
    what: str
    """The statement."""
    next: str
    """The next step; empty when no action is needed."""
    key: str | None = None
    """The input needed for it, a key of `errors.ERROR_KEYS`."""
    sensors: tuple[str, ...] = SENSORS
    """Sensors with parameters that it concerns."""

    def advice(self, hints: dict[str, str] | None = None) -> str:
        """
        Return the next step with the local name of its key (`errors.with_hint`); empty for none.
        """
        return with_hint(self.next, self.key, hints or {}) if self.next else ''


@dataclass(frozen=True)
class Verdict:
    """The decisions with all statements, the most important first."""

    decisions: dict[str, SensorDecision]
    """Sensor -> decision."""
    reasons: tuple[Reason, ...]
    """Decisions, parameters, warnings, notes."""
    within: int
    """Requested parameters that are determined."""
    requested: int
    """Requested parameters."""
    limiting: tuple[str, float]
    """
    The requested parameter with the largest sd in units of its tolerance, and that ratio; ('', 0)
    without any.
    """
    complete: bool
    """Whether the exit code is 0 (`outcome.shortcomings`)."""

    @property
    def word(self) -> SensorDecision:
        """The more cautious of the decisions."""
        return most_cautious(self.decisions.values())

    @property
    def text(self) -> str:
        """The decisions in one phrase."""
        return decisions_text(self.decisions)

    def lines(self, hints: dict[str, str] | None = None) -> list[str]:
        """Return the statements and next steps, a line each; `hints` as for `errors.with_hint`."""
        return lines_of(self.reasons, hints)


def lines_of(reasons: Iterable[Reason], hints: dict[str, str] | None = None) -> list[str]:
    """Return statements and next steps, a line each; `hints` as for `errors.with_hint`."""
    lines = []
    for reason in reasons:
        if reason.word in (WARNING, NOTE):
            lines.append(f'{reason.word}: {reason.what}')
        else:
            lines.append(reason.what)
        if reason.next:
            lines.append(f'next: {reason.advice(hints)}')
    return list(dict.fromkeys(lines))  # each line once
