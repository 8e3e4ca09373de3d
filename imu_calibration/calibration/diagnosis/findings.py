"""
From the result of a search to findings, their gains, and motions.

The search is on a table or by hand. The findings are sentences, and the motions separate effects.
"""

from collections.abc import Callable, Collection, Mapping, Sequence

from imu_calibration.calibration.diagnosis.diagnosis_result import (
    Candidate,
    Finding,
    ParameterEstimate,
    parameters_of,
)
from imu_calibration.core.units import for_people, with_sd
from imu_calibration.document.calibration import beyond_known
from imu_calibration.effects.base import Effect
from imu_calibration.effects.motions import ALL_MOTIONS
from imu_calibration.estimation.solution import Solution
from imu_calibration.selection.gain import Gain
from imu_calibration.selection.questions import Question, with_exchanged
from imu_calibration.selection.search import FAMILY_WISE, Score, Search


def motions_of(question: Question, mate: Question) -> str:
    """Return the motions that excite either of two effects, as text."""
    texts = []
    for name in question.effect.motion + mate.effect.motion:
        if name in ALL_MOTIONS and ALL_MOTIONS[name] not in texts:
            texts.append(ALL_MOTIONS[name])
    return '; '.join(texts)


LEAVES_MOST = 'rejected: most of the residual would remain'
"""Verdict on an effect that is significant, but removes too small a share."""
DISAGREED = 'refused: the windows do not agree on it'
"""Verdict on an effect with evidence from few windows only, or with contradictory windows."""
IMPOSSIBLE = 'refused: its size is impossible, or within the steps of the encoders'
"""Verdict on an effect with an estimate that no instrument can have."""
REPLACED = 'refused: a formula, a place or the temperature explains the same'
"""Verdict on an effect without which the residual is explained as well."""
UNCERTAIN = 'refused: none of its coefficients is significant in the calibration'
"""Verdict on an effect that a solution with all allowances does not determine."""


def sentence(
    effect: Effect,
    parameters: dict[str, ParameterEstimate],
    gain: Gain | None,
    *,
    n_clipped: int | None = None,
) -> str:
    """
    Return a finding in one or two sentences, with its size in common units.

    Parameters
    ----------
    effect : Effect
    parameters : dict
        Name -> estimate; the moment or the time constant comes last.
    gain : Gain or None
    n_clipped : int, optional
        Samples at a limit.

    """
    # The size is the largest amplitude. An amplitude within 2 sd is not: it may be large because it
    # is collinear with another parameter, such as the bias.
    amplitudes = effect.amplitudes(list(parameters))  # names
    significant = [
        name for name in amplitudes if abs(parameters[name].value) > 2 * parameters[name].sd
    ]
    largest = max(significant or amplitudes, key=lambda name: abs(parameters[name].value))
    value, sd, unit = parameters[largest]
    factor, unit = for_people(unit, effect.sensor)
    if n_clipped is not None:
        limit = _with_unit(f'{value * factor:.4g}', unit)
        return (
            f'{effect.explanation} The limit is {limit}; {n_clipped} samples at it and neighbouring'
            ' samples were excluded.'
        )

    # The size with its parameter, and the moment of a step.
    size = _with_unit(' +- '.join(with_sd(value * factor, sd * factor)), unit)
    if not significant and len(parameters) > 1:
        size = f'known here in combinations only, none of its values by itself: {size}'
    if len(amplitudes) > 1:
        size += f' (largest: {largest.split(".")[-1]})'
    if effect.located:
        *_, moment = parameters.values()
        size += f' at {moment.value:.1f} s'
    text = f'{effect.explanation} Its size is {size}.'
    if gain is not None and gain.reduction > 0:
        text += (
            f' With it the {gain.of} ({gain.sensor}, held-out {gain.measure}) falls by'
            f' {_percent(gain.reduction)}.'
        )
    return text


def _percent(share: float) -> str:
    """Return a share in per cent, with one digit below one per cent."""
    return f'{100 * share:.0f} %' if share >= 0.01 else f'{100 * share:.1g} %'


def _with_unit(number: str, unit: str) -> str:
    """Return a number with its unit, but for a ratio."""
    return number if unit == '1' else f'{number} {unit}'


def candidates_of(
    search: Search,
    named: Sequence[Question],
    *,
    agree: Callable[[Sequence[Question], Question], bool] | None = None,
    withdrawn: Sequence[Question] = (),
    replaced: Sequence[Question] = (),
) -> tuple[Candidate, ...]:
    """
    Return every effect that a search tested, the strongest first; of a warm-up one time constant.

    The time constant of a warm-up is the one with the largest gain.

    Parameters
    ----------
    search : Search
    named : sequence of Question
        Findings.
    agree : callable, optional
        ``agree(chosen, question)``: whether the windows agree on one of the chosen effects.
    withdrawn : sequence of Question
        Effects that the search chose, and that the halves of the recording or the calibration
        refused.
    replaced : sequence of Question
        Effects that another explanation of the residual replaces.

    """
    replaced_names = {question.name for question in replaced}
    withdrawn_names = {question.name for question in withdrawn}
    finding_names = {question.name for question in named}
    mates = {}  # effect -> the finding with which it is collinear
    for question in named:
        for mate, _ in search.confounded(named, question):
            mates.setdefault(mate.name, question.name)

    candidates: dict[str, Candidate] = {}
    for question in search.questions:
        name = question.name
        alone = search.score([], question)
        if name in candidates and candidates[name].gain_alone >= alone.gain:
            continue
        in_addition = None if name in finding_names else search.score(named, question)
        verdict = _verdict_of(name, alone, in_addition, finding_names=finding_names, mates=mates)
        if verdict == LEAVES_MOST:  # significant, and no finding: the best known reason
            if name in replaced_names:
                verdict = REPLACED
            elif agree is not None and not agree([*named, question], question):
                verdict = DISAGREED
            elif name in withdrawn_names:
                verdict = UNCERTAIN
        candidates[name] = Candidate(
            name,
            question.sensor,
            gain_alone=alone.gain,
            p_value_alone=alone.p_value,
            gain_beside=None if in_addition is None else in_addition.gain,
            p_value_beside=None if in_addition is None else in_addition.p_value,
            verdict=verdict,
        )
    return tuple(sorted(candidates.values(), key=lambda candidate: -candidate.gain_alone))


def _verdict_of(
    name: str,
    alone: Score,
    in_addition: Score | None,
    *,
    finding_names: Collection[str],
    mates: Mapping[str, str],
) -> str:
    """
    Return the verdict on an effect as text.

    It is 'found', 'as good as NAME', 'not needed in addition to the findings', 'no evidence', or
    why the effect was refused.

    Parameters
    ----------
    name : str
        Effect.
    alone, in_addition : Score
        Evidence in addition to the baseline, and to the findings (None for a finding).
    finding_names : set of str
        Effects that are findings.
    mates : dict
        Effect -> the finding with which it is collinear.

    """
    if name in finding_names:
        return 'found'
    if name in mates:
        return f'as good as {mates[name]}'
    if not alone.allowed and alone.p_value < FAMILY_WISE and alone.gain > 0:
        return IMPOSSIBLE
    if in_addition is not None and in_addition.significant:
        return LEAVES_MOST
    if alone.significant:
        return 'not needed in addition to the findings' if finding_names else LEAVES_MOST
    return 'no evidence'


def finding(
    search: Search,
    named: Sequence[Question],
    place: int,
    *,
    solution: Solution,
    share: Callable,
    gain_of: Callable,
    motion_of: Callable,
    shows: Callable = lambda place, mate, gain: True,
    rivals: Sequence[Question] = (),
) -> Finding:
    """
    Return the Finding of the effect at `place` among the findings.

    Parameters
    ----------
    search : Search
        On which they were chosen.
    named : list of Question
        In the order found.
    solution : Solution
        Of the extended model; effects that it lacks are reported with the values of the search.
    share : callable
        ``share(named, question)``: share of the unexplained that the effect removes.
    gain_of : callable
        ``gain_of(place)``: the Gain of this effect on top of the preceding ones.
    motion_of : callable
        ``motion_of(question, mate)``: the motion that would separate two effects.
    shows : callable
        ``shows(place, mate, gain)``: whether an effect in the place of this one affects the sensor
        on which the gain of this one was computed.
    rivals : sequence of Question
        Effects known to do nearly as well in its place.

    """
    question = named[place]
    score = search.score([other for other in named if other is not question], question)
    gain = gain_of(place)
    explained_share = share(named, question)
    if question.effect.key in solution.model.slices:
        parameters = parameters_of(solution, question.sensor, question.name)
    else:
        parameters = fitted(search, named, question)
    text = sentence(question.effect, parameters, gain)
    if score.implausible:
        text += (
            f' It {beyond_known(explained_share, question.sensor)}. It is in no model unless'
            ' requested.'
        )

    # Effects that are collinear with it, and their sizes in its place.
    mates = list(rivals)
    rival_names = {rival.name for rival in rivals}
    for mate, _ in search.confounded(named, question):
        if mate.name not in rival_names and shows(place, mate, gain):
            mates.append(mate)
    sizes_of_mates = {}
    for mate in mates:
        estimates = fitted(search, with_exchanged(named, place, mate), mate)
        sizes_of_mates[mate.name] = {
            name: (estimate.value, estimate.unit) for name, estimate in estimates.items()
        }
    return Finding(
        question.name,
        question.sensor,
        explanation=text,
        parameters=parameters,
        p_value=score.p_value,
        heldout_gain=score.gain,
        share=explained_share,
        gain=gain,
        indistinguishable_from=tuple(mate.name for mate in mates),
        separating_motion=motion_of(question, mates[0]) if mates else '',
        against=question.effect.against,
        sizes_of_mates=sizes_of_mates,
        implausible=score.implausible,
    )


def fitted(
    search: Search, named: Sequence[Question], question: Question
) -> dict[str, ParameterEstimate]:
    """Return parameter name -> its estimate, of an effect, fitted with the choice `named`."""
    values, sds = search.estimate(named, question)
    parameters = {}
    for k, name in enumerate(question.effect.param_names()[: len(values)]):
        parameters[name] = ParameterEstimate(
            float(values[k]), float(sds[k]), question.effect.unit_of(k)
        )
    return parameters
