"""
From the result of a search to findings, their gains, and motions.

The search is on a table or by hand. The findings are sentences, and the motions separate effects.
"""

from collections.abc import Callable, Collection, Mapping, Sequence

from imu_calibration.calibration.diagnosis.diagnosis_result import (
    Candidate,
    Finding,
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
    """Return the motions that two effects declare as theirs."""
    return '; '.join(
        dict.fromkeys(
            ALL_MOTIONS[name]
            for name in question.effect.motion + mate.effect.motion
            if name in ALL_MOTIONS
        )
    )


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
    parameters: dict[str, tuple[float, float, str]],
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
        Name -> (value, sd, unit).
    gain : Gain or None
    n_clipped : int, optional
        Samples at a limit.

    """
    values = [(name.split('.')[-1], *entry) for name, entry in parameters.items()]
    amplitudes = effect.amplitudes(values)
    # A parameter that is collinear with another, such as the bias, is not a size.
    known = [entry for entry in amplitudes if abs(entry[1]) > 2 * entry[2]]
    label, value, sd, unit = max(known or amplitudes, key=lambda v: abs(v[1]))
    factor, unit = for_people(unit, effect.sensor)
    size = _with_unit(' +- '.join(with_sd(value * factor, sd * factor)), unit)
    if not known and len(values) > 1:
        size = f'known here in combinations only, none of its values by itself: {size}'
    if n_clipped is not None:
        limit = _with_unit(f'{value * factor:.4g}', unit)
        return (
            f'{effect.explanation} The limit is {limit}; {n_clipped} samples at it and neighbouring'
            ' samples were excluded.'
        )
    which = '' if len(amplitudes) == 1 else f' (largest: {label})'
    when = f' at {values[-1][1]:.1f} s' if effect.located else ''
    text = f'{effect.explanation} Its size is {size}{which}{when}.'
    if gain is not None and gain.reduction > 0:
        text += (
            f' With it the {gain.of} ({gain.sensor}, held-out {gain.measure}) falls by'
            f' {_percent(gain.reduction)}.'
        )
    return text


def _percent(share: float) -> str:
    return f'{100 * share:.0f} %' if share >= 0.01 else f'{100 * share:.1g} %'


def _with_unit(number: str, unit: str) -> str:
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
    Return every effect that a search tested in addition to the findings, the strongest first.

    Of a warm-up its best time constant.

    `agree(chosen, question)` is whether the windows agree on one of the chosen effects; `withdrawn`
    are effects that the search chose and the halves of the recording or the calibration refused,
    `replaced` those that another explanation of the residual replaces.
    """
    superseded = {question.name for question in replaced}
    refused_later = {question.name for question in withdrawn}
    found = {question.name for question in named}
    mates = {}
    rows = {}
    for question in named:
        for mate, _ in search.confounded(named, question):
            mates.setdefault(mate.name, question.name)
    for question in search.questions:
        alone = search.score([], question)
        if question.name in rows and rows[question.name].gain_alone >= alone.gain:
            continue
        beside = None if question.name in found else search.score(named, question)
        verdict = _verdict_of(question.name, alone, beside, found=found, mates=mates)
        if verdict == LEAVES_MOST:
            if question.name in superseded:
                verdict = REPLACED
            elif agree is not None and not agree([*named, question], question):
                verdict = DISAGREED
            elif question.name in refused_later:
                verdict = UNCERTAIN
        rows[question.name] = Candidate(
            question.name,
            question.sensor,
            alone.gain,
            alone.p_value,
            None if beside is None else beside.gain,
            None if beside is None else beside.p_value,
            verdict,
        )
    return tuple(sorted(rows.values(), key=lambda row: -row.gain_alone))


def _verdict_of(
    name: str,
    alone: Score,
    beside: Score | None,
    *,
    found: Collection[str],
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
    alone, beside : Score
        Evidence on top of the baseline, and on top of the findings (None for a finding).
    found : set of str
        Findings.
    mates : dict
        Effects that would do as well -> finding.

    """
    if name in found:
        return 'found'
    if name in mates:
        return f'as good as {mates[name]}'
    if not alone.allowed and alone.p_value < FAMILY_WISE and alone.gain > 0:
        return IMPOSSIBLE
    if beside is not None and beside.significant:
        return LEAVES_MOST
    if alone.significant:
        return 'not needed in addition to the findings' if found else LEAVES_MOST
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
        ``shows(place, mate, gain)``: whether an effect in the place of this one shows in the sensor
        that shows this one.
    rivals : sequence of Question
        Effects known to do nearly as well in its place.

    """
    question = named[place]

    def in_its_place(mate: Question) -> dict[str, tuple[float, float, str]]:
        return fitted(search, with_exchanged(named, place, mate), mate)

    score = search.score([q for q in named if q is not question], question)
    gain = gain_of(place)
    explained = share(named, question)
    if question.effect.key in solution.model.slices:
        parameters = parameters_of(solution, question.sensor, question.name)
    else:
        parameters = fitted(search, named, question)
    text = sentence(question.effect, parameters, gain)
    if score.implausible:
        text += (
            f' It {beyond_known(explained, question.sensor)}. It is in no model unless requested.'
        )
    mates = list(rivals)
    rival_names = {rival.name for rival in rivals}
    for mate, _ in search.confounded(named, question):
        if mate.name not in rival_names and shows(place, mate, gain):
            mates.append(mate)
    sizes_of_mates = {}
    for mate in mates:
        in_place = in_its_place(mate)
        sizes_of_mates[mate.name] = {n: (value, unit) for n, (value, _, unit) in in_place.items()}
    return Finding(
        question.name,
        question.sensor,
        text,
        parameters,
        score.p_value,
        score.gain,
        explained,
        gain,
        tuple(mate.name for mate in mates),
        motion_of(question, mates[0]) if mates else '',
        question.effect.against,
        sizes_of_mates,
        score.implausible,
    )


def fitted(
    search: Search, named: Sequence[Question], question: Question
) -> dict[str, tuple[float, float, str]]:
    """Return parameter name -> (value, sd, unit) of a chosen effect as the search fitted it."""
    names = question.effect.param_names()
    return {
        name: (float(value), float(sd), question.effect.unit_of(k))
        for k, (name, value, sd) in enumerate(zip(names, *search.estimate(named, question)))
    }
