"""
One explanation of the lags of both sensors: the simplest that the recording allows.

A late clock, a delay of one sensor and its filters have the same first derivative, so a search
meets them in any order, and halves of one recording may name one lag differently. Here each kind
of lag (`LAG_KINDS`) of both sensors is linearised at its own estimate. An explanation is a
kind for each sensor, or a common clock with the remaining lags; its cost is the sum over the
sensors. Of all explanations within the search's price of the best the simplest is selected: fewest
effects first, then a common clock before separate lags, then a delay before a filter. All other
ones are its rivals.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from imu_calibration.effects.base import SENSORS, Effect
from imu_calibration.effects.reference_effects import CLOCK, CLOCKS, FAMILY, lag_name
from imu_calibration.references.turntable.selection.extended_model import point_with
from imu_calibration.references.turntable.selection.linearised_problem import (
    LinearisedProblem,
    SearchedWindows,
)
from imu_calibration.references.turntable.selection.rivals import (
    MIN_CURVATURE_NATS,
    Rival,
    same_questions,
)
from imu_calibration.selection.questions import Question
from imu_calibration.selection.search import PENALTY, TIE

LAG_KINDS = (('delay',), ('bandwidth',), ('filter',), ('delay', 'bandwidth'))
"""Descriptions of one sensor's lag, the simplest first."""
DELAY = LAG_KINDS[0]
FIRST_SHARE = 0.3
"""
Initial share of the low-pass in a lag with a delay: at zero its derivative equals the delay's.
"""
MAX_CLOCK_LOSS = 0.01
"""
Without rests: largest loss of a common clock against separate lags, as a share of their log
likelihood: noise is estimated from the misfit there, and the evidence that separates a motor's
ripple from a filter is not reproducible between recordings.
"""
DELAY_LINEARISATIONS = 3
"""Linearisations of a delay with a low-pass."""


@dataclass(frozen=True, eq=False)
class LagHypothesis:
    """Lags of one kind of both sensors, linearised at their estimates."""

    kind: tuple[str, ...]
    """One of `LAG_KINDS`."""
    problem: LinearisedProblem
    """Problem with the columns of these lags."""
    chosen: list[Question]
    """The lags of both sensors, then the other chosen effects."""

    @property
    def values(self) -> dict[str, float]:
        """Parameter of the baseline, of the lags and of clocks that change -> value."""
        names = set(self.problem.baseline.param_names)
        for question in self.chosen:
            if question.name in FAMILY | CLOCKS:
                names.update(question.effect.param_names())
        values = zip(self.problem.space.names, self.problem.values(self.chosen))
        return {name: value for name, value in values if name in names}

    def lags(self, sensor: str) -> tuple[np.ndarray, np.ndarray]:
        """Return (values, covariance) of the lags of one sensor, in the order of the kind."""
        fitted = self.problem.search.indices(self.chosen)
        values, covariance = self.problem.evidence.fit(fitted)
        # A lag has one parameter.
        parameter = {question.name: question.parameters[0] for question in self.chosen}
        # Places of the lags among the fitted parameters.
        places = [fitted.index(parameter[lag_name(sensor, ending)]) for ending in self.kind]
        return values[places], covariance[np.ix_(places, places)]

    def without(self, sensor: str) -> list[Question]:
        """Return the choice without the lags of one sensor."""
        return [q for q in self.chosen if q.name not in FAMILY or q.sensor != sensor]


@dataclass(frozen=True, eq=False)
class Explanation:
    """Effects that cause the lags of both sensors, with their values."""

    lags: dict[str, float]
    """Effect (lag of a sensor, or the clock) -> value, s."""
    cost: float
    """Held-out cost, nats, penalties included."""
    values: dict[str, float] = field(default_factory=dict)
    """Parameter of the baseline and of clocks that change -> value."""

    @property
    def rank(self) -> tuple[int, bool, int, float]:
        """
        Sort key, the simplest explanation first.

        Number of effects, no common clock, complexity of the kinds of lag, cost.
        """
        complexity = 0
        for name in self.lags:
            ending = name.rpartition('_')[2]
            complexity += ('delay', 'offset', 'bandwidth', 'filter').index(ending)
        return len(self.lags), CLOCK not in self.lags, complexity, self.cost


@dataclass(frozen=True, eq=False)
class LagExplanations:
    """All explanations of the lags of a recording."""

    problem: LinearisedProblem
    """Linearised where no lag acts."""
    explanations: Sequence[Explanation]
    """Each costs less than no lag."""
    other_effects: Sequence[Question]
    """Chosen effects that are no lags."""
    cost_without_lag: float | None
    """Held-out cost without any lag, nats, without rests; None where rests determine the noise."""

    def others(self, max_effects: int, refused: Sequence[Explanation]) -> list[Explanation]:
        """
        Return the explanations with at most `max_effects` effects, without the refused ones.

        Explanations with the same columns as a refused one have its cost, and are refused too.
        """
        refused_costs = {explanation.cost for explanation in refused}
        others = []
        for explanation in self.explanations:
            if len(explanation.lags) <= max_effects and explanation.cost not in refused_costs:
                others.append(explanation)
        return others

    def settled(self, selected: Explanation, searched: SearchedWindows) -> 'SettledLags':
        """Return an explanation with the problem linearised at its lags."""
        parameter = {effect.name: effect.param_names()[0] for effect in self.problem.effects}
        lags_of_parameters = {parameter[name]: lag for name, lag in selected.lags.items()}
        values = selected.values | lags_of_parameters
        settled = searched.linearised(
            point=point_with(self.problem.baseline, self.problem.effects, values)
        )

        questions = _questions_by_name(settled)
        lags = [questions[name] for name in selected.lags]
        chosen = [*lags, *same_questions(settled, self.other_effects)]
        near = [each for each in self.explanations if each.cost < selected.cost + TIE]
        return SettledLags(settled, chosen, _rivals(settled, selected, near))


@dataclass(frozen=True, eq=False)
class SettledLags:
    """An explanation of the lags, linearised at its lags."""

    problem: LinearisedProblem
    """The problem there."""
    chosen: list[Question]
    """The lags of the explanation, then the other chosen effects."""
    rivals: list[Rival]
    """Alternatives to the lags that fit nearly as well."""


def _questions_by_name(problem: LinearisedProblem) -> dict[str, Question]:
    """Return effect -> its first question (of a warm-up that of the first time constant)."""
    first: dict[str, Question] = {}
    for question in problem.questions:
        first.setdefault(question.name, question)
    return first


def lag_explanations(
    problem: LinearisedProblem, chosen: Sequence[Question], searched: SearchedWindows
) -> LagExplanations | None:
    """
    Return the LagExplanations of a choice.

    None where it has no lag, no lag explains the data, or some of the family cannot be tested.

    Parameters
    ----------
    problem : LinearisedProblem
        Linearised where no lag acts.
    chosen : sequence of Question
    searched : SearchedWindows
        For the LinearisedProblem elsewhere, or with some of the effects.

    """
    effects = {effect.name: effect for effect in problem.effects}
    has_lag = any(question.name in FAMILY for question in chosen)
    if not has_lag or not FAMILY <= set(effects):
        return None
    # Warm-ups of the bank ('@') are left to the search at the lags.
    other_effects = [each for each in chosen if each.name not in FAMILY and '@' not in each.label]

    # Where a clock changes, the lags are linearised at its estimated rate or step, not at zero.
    values = problem.values(chosen)
    clocks = {}
    for question in chosen:
        if question.name in CLOCKS:
            for k in question.parameters:
                clocks[problem.space.names[k]] = float(values[k])
    hypotheses = _hypotheses(searched, effects, other_effects=other_effects, clocks=clocks or None)

    judges = [each.problem for each in hypotheses]
    # Parameters are named 'sensor.effect.component'.
    names = [name for name in hypotheses[0].values if name.split('.')[1] not in FAMILY]
    explanations = _explanations(hypotheses, judges, names)
    if not explanations:
        return None

    # Without rests the noise is that of the misfit: the cost without a lag is the scale of costs.
    cost_without_lag = None
    if problem.recording.moving.all():
        without = [question for question in hypotheses[0].chosen if question.name not in FAMILY]
        cost_without_lag = sum(_cost(hypotheses[0], without, judges, sensor) for sensor in SENSORS)
    return LagExplanations(problem, explanations, other_effects, cost_without_lag)


def simplest(
    explanations: Sequence[Explanation], cost_without_lag: float | None = None
) -> Explanation:
    """
    Return the simplest explanation within the search's price of the best.

    Parameters
    ----------
    explanations : sequence of Explanation
    cost_without_lag : float, optional
        Cost without any lag, for a recording without rests: an explanation of as many effects with
        a common clock is then accepted within the resolution of the misfit.

    """
    best_cost = min(each.cost for each in explanations)
    near = [each for each in explanations if each.cost < best_cost + TIE]
    selected = min(near, key=lambda each: each.rank)
    if cost_without_lag is None:
        return selected
    if len(selected.lags) < 2 or CLOCK in selected.lags:  # no separate lags of both sensors
        return selected

    # Without rests: a common clock in place of separate lags, up to `MAX_CLOCK_LOSS`.
    largest_cost = best_cost + TIE + MAX_CLOCK_LOSS * (cost_without_lag - best_cost)
    with_common_clock = []
    for each in explanations:
        has_as_many = CLOCK in each.lags and len(each.lags) == len(selected.lags)
        if has_as_many and each.cost < largest_cost:
            with_common_clock.append(each)
    return simplest(with_common_clock) if with_common_clock else selected


def _hypotheses(
    searched: SearchedWindows,
    effects: Mapping[str, Effect],
    *,
    other_effects: Sequence[Question],
    clocks: dict[str, float] | None,
) -> list[LagHypothesis]:
    """
    Return the hypothesis of each kind of lag; only that of delays if no curvature is observable.

    Parameters
    ----------
    searched : SearchedWindows
    effects : dict
        Name -> candidate effect.
    other_effects : sequence of Question
        Chosen effects that are no lags.
    clocks : dict, optional
        Parameter of a clock that changes -> value for the first linearisation.

    """
    # Delays only, at zero; without an observable curvature all kinds have the same columns.
    first = _hypothesis(searched, DELAY, clocks, effects=effects, other_effects=other_effects)
    curvatures = []
    for question in first.chosen:
        if question.name in FAMILY:
            curvatures.append(first.problem.curvature_shows(first.chosen, question))
    if max(curvatures) < MIN_CURVATURE_NATS:
        return [first]

    # Delays at their own estimate, then each other kind from there.
    first = _hypothesis(searched, DELAY, first.values, effects=effects, other_effects=other_effects)
    hypotheses = [first]
    for kind in LAG_KINDS[1:]:
        # The whole lag of each sensor is that of the delay; two lags share it.
        values = dict(first.values)
        for sensor in SENSORS:
            estimates, _ = first.lags(sensor)
            delay = estimates[0]
            lags = [delay]
            if len(kind) == 2:
                low_pass = FIRST_SHARE * abs(delay)
                lags = [delay - low_pass, low_pass]
            for ending, lag in zip(kind, lags, strict=True):
                values[effects[lag_name(sensor, ending)].param_names()[0]] = lag
        # A delay with a low-pass is linearised at its own estimate.
        for _ in range(DELAY_LINEARISATIONS if len(kind) > 1 else 1):
            hypothesis = _hypothesis(
                searched, kind, values, effects=effects, other_effects=other_effects
            )
            values = hypothesis.values
        hypotheses.append(hypothesis)
    return hypotheses


def _hypothesis(
    searched: SearchedWindows,
    kind: tuple[str, ...],
    values: dict[str, float] | None,
    *,
    effects: Mapping[str, Effect],
    other_effects: Sequence[Question],
) -> LagHypothesis:
    """Return the lags of one kind, linearised at values of parameters or at the baseline."""
    names = [lag_name(sensor, ending) for ending, sensor in product(kind, SENSORS)]
    compared = [effects[name] for name in names] + [question.effect for question in other_effects]
    point = None
    if values is not None:
        point = point_with(searched.baseline, compared, values)
    there = searched.linearised(point, effects=compared)
    known = _questions_by_name(there)
    lags = [known[name] for name in names]
    return LagHypothesis(kind, there, [*lags, *same_questions(there, other_effects)])


def _explanations(
    hypotheses: Sequence[LagHypothesis], judges: Sequence[LinearisedProblem], names: Sequence[str]
) -> list[Explanation]:
    """
    Return every Explanation of a lag of each sensor that costs less than no lag.

    Parameters
    ----------
    hypotheses : sequence of LagHypothesis
    judges : sequence of LinearisedProblem
        Problems whose noise judges the costs.
    names : sequence of str
        Parameters of the baseline and of clocks that change.

    """
    # Each sensor without a lag, and with one of each kind.
    options = []
    cost_without = 0.0
    for sensor in SENSORS:
        no_lag = _without_lag(hypotheses[0], judges, sensor)
        cost_without += no_lag.cost
        with_lag = [_option(hypothesis, judges, sensor) for hypothesis in hypotheses]
        of_sensor = [no_lag, *with_lag]
        if len(hypotheses) == 1:
            # Delays only: no curvature is observable, and the fit of a low-pass is that of a delay.
            for ending in ('bandwidth', 'filter'):
                of_sensor.append(replace(with_lag[0], kind=(ending,), alike=True))
        options.append(of_sensor)

    explanations = []
    for of_accelerometer, of_gyroscope in product(*options):
        for explanation in _explanations_of_pair(of_accelerometer, of_gyroscope, names):
            if explanation.cost < cost_without:
                explanations.append(explanation)
    return explanations


@dataclass(frozen=True, eq=False)
class _Option:
    """One sensor with a lag of one kind, or with none."""

    sensor: str
    """'accelerometer' or 'gyroscope'."""
    kind: tuple[str, ...]
    """Endings of the names of its lags, one of `LAG_KINDS`; none without a lag."""
    cost: float
    """Held-out cost of the windows of this sensor, nats, penalties included."""
    lags: np.ndarray
    """Estimates of the lags in the order of `kind`, s, shape (n,)."""
    covariance: np.ndarray
    """Their covariance, shape (n, n)."""
    values: dict[str, float]
    """Parameter of the baseline and of clocks that change -> value."""
    alike: bool = False
    """Whether its columns equal those of a delay."""

    def named(self, lags: Sequence[float] | np.ndarray) -> dict[str, float]:
        """Return effect -> lag, for values in the order of `kind`."""
        return {lag_name(self.sensor, ending): float(lag) for ending, lag in zip(self.kind, lags)}

    def with_delay(self, delay: float) -> np.ndarray:
        """Return the lags of least squares with the first one fixed at `delay`, shape (n,)."""
        return self.lags + self.covariance[:, 0] / self.covariance[0, 0] * (delay - self.lags[0])


def _option(hypothesis: LagHypothesis, judges: Sequence[LinearisedProblem], sensor: str) -> _Option:
    """Return one sensor with the lag of a hypothesis."""
    cost = _cost(hypothesis, hypothesis.chosen, judges, sensor) + PENALTY * len(hypothesis.kind)
    lags, covariance = hypothesis.lags(sensor)
    return _Option(
        sensor,
        kind=hypothesis.kind,
        cost=cost,
        lags=lags,
        covariance=covariance,
        values=hypothesis.values,
    )


def _without_lag(
    hypothesis: LagHypothesis, judges: Sequence[LinearisedProblem], sensor: str
) -> _Option:
    """Return one sensor without a lag, fitted with the columns of a hypothesis."""
    chosen = hypothesis.without(sensor)
    values = dict(zip(hypothesis.problem.space.names, hypothesis.problem.values(chosen)))
    cost = _cost(hypothesis, chosen, judges, sensor)
    return _Option(
        sensor,
        kind=(),
        cost=cost,
        lags=np.zeros(0),
        covariance=np.zeros((0, 0)),
        values=values,
    )


def _cost(
    hypothesis: LagHypothesis,
    chosen: Sequence[Question],
    judges: Sequence[LinearisedProblem],
    sensor: str,
) -> float:
    """
    Return the held-out cost of the windows of one sensor for a choice of effects, nats.

    It is the mean over the noise and the band of each of the `judges`.
    """
    used = hypothesis.problem.search.indices(chosen)
    losses = [
        hypothesis.problem.judged_by(judge).heldout_parts(used)[sensor].sum() for judge in judges
    ]
    return 0.5 * float(np.mean(losses))


def _explanations_of_pair(
    one: _Option, two: _Option, names: Sequence[str]
) -> Iterator[Explanation]:
    """
    Yield the explanations of the lags of both sensors, `one` and `two`.

    The lags are separate, or a common clock and the additional lags of each sensor. Lags of sensors
    are positive, the common clock may have either sign. Nothing if no
    sensor has a lag. `names` are the parameters of which an explanation has the values.
    """
    if not (one.kind or two.kind):
        return
    values = {}
    for name in names:
        of_its_sensor = two if name.startswith(two.sensor) else one
        values[name] = of_its_sensor.values[name]
    cost = one.cost + two.cost

    # Separate lags.
    separate = one.named(one.lags) | two.named(two.lags)
    if all(lag > 0 for lag in separate.values()):
        yield Explanation(separate, cost, values)
    if not (one.kind and two.kind):
        return

    # A common clock with the smaller lag, and the difference as lag of the later sensor. The fit,
    # and so the cost, is that of separate lags.
    difference = float(one.lags[0] - two.lags[0])
    later, earlier = (one, two) if difference > 0 else (two, one)
    if earlier.kind == DELAY and (later.kind == DELAY or later.alike):
        clock = {CLOCK: float(earlier.lags[0])}
        yield Explanation(clock | later.named([abs(difference)]), cost, values)

    # A common clock, their weighted mean, in place of both delays: one parameter less, so that the
    # cost falls by its penalty and rises by the misfit d^2 / (2 (v1 + v2)) of their difference d
    # with variances v1, v2. The other lags of both sensors follow by least squares.
    if one.kind[0] == two.kind[0] == 'delay':
        variances = np.array([one.covariance[0, 0], two.covariance[0, 0]])  # of both delays
        shared = float(np.average([one.lags[0], two.lags[0]], weights=1 / variances))
        remaining = one.named(one.with_delay(shared)) | two.named(two.with_delay(shared))
        remaining = {name: lag for name, lag in remaining.items() if not name.endswith('delay')}
        if all(lag > 0 for lag in remaining.values()):
            misfit = 0.5 * difference**2 / float(variances.sum())
            yield Explanation({CLOCK: shared} | remaining, cost - PENALTY + misfit, values)


def _rivals(
    settled: LinearisedProblem, selected: Explanation, near: Sequence[Explanation]
) -> list[Rival]:
    """
    Return the lags of other explanations as rivals of the selected explanation's lags.

    Parameters
    ----------
    settled : LinearisedProblem
        Linearised at the selected explanation.
    selected : Explanation
    near : sequence of Explanation
        Explanations of nearly the same cost; those with more effects do not count.

    """
    question_of = {question.name: question for question in settled.questions}
    rivals: dict[str, Rival] = {}  # added lag -> its rival, from the explanation of least cost
    for other in sorted(near, key=lambda explanation: explanation.cost):
        removed = sorted(set(selected.lags) - set(other.lags))
        added = sorted(set(other.lags) - set(selected.lags))
        if len(other.lags) > len(selected.lags) or not removed:
            continue
        moves = {name: other.values[name] - selected.values[name] for name in selected.values}
        for name in added:
            if name in rivals:
                continue

            # It replaces a lag of the same sensor, otherwise the clock or the first removed lag.
            sensor = question_of[name].sensor
            otherwise = CLOCK if CLOCK in removed else removed[0]
            replaced = next(
                (lag for lag in removed if question_of[lag].sensor == sensor), otherwise
            )

            # The moves of the other parameters are those of the whole explanation: they are in one
            # rival of each replaced lag only.
            with_moves = {rival.question.name for rival in rivals.values()}
            rivals[name] = Rival(
                question=question_of[replaced],
                other=question_of[name],
                behind=other.cost - selected.cost,
                moves={} if replaced in with_moves else moves,
            )
    return list(rivals.values())
