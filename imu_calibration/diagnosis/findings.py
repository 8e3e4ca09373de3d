"""One chosen effect as a finding, the same on a table and by hand."""

from collections.abc import Sequence
from typing import Callable

from imu_calibration.diagnosis.result import Finding, parameters_of
from imu_calibration.diagnosis.sentences import sentence
from imu_calibration.estimation.solution import Solution
from imu_calibration.selection.questions import Question
from imu_calibration.selection.search import Search


def finding(search: Search, named: Sequence[Question], place: int, *, solution: Solution, share: Callable, gain_of: Callable,
            motion_of: Callable, shows: Callable = lambda place, mate, gain: True, rivals: Sequence[Question] = ()) -> Finding:
    """
    Return the Finding of the effect at `place` among those named.

    Parameters
    ----------
    search : Search
        On which they were chosen.
    named : list of Question
        In the order found.
    solution : Solution
        Of the extended model.
    share : callable
        ``share(named, question)``: share of the unexplained that the effect removes.
    gain_of : callable
        ``gain_of(place)``: the Gain of this effect on top of those before it.
    motion_of : callable
        ``motion_of(question, mate)``: the motion that would tell two effects apart.
    shows : callable
        ``shows(place, mate, gain)``: whether an effect in the place of this one shows in the sensor that shows this one.
    rivals : sequence of Question
        Effects known to do nearly as well in its place.

    """
    question = named[place]
    score = search.score([q for q in named if q is not question], question)
    parameters, gain = parameters_of(solution, question.sensor, question.name), gain_of(place)
    mates = [*rivals, *(mate for mate, _ in search.class_mates(named, question)
                        if mate.name not in {rival.name for rival in rivals} and shows(place, mate, gain))]
    return Finding(question.name, question.sensor, sentence(question.effect, parameters, gain), parameters, score.p_value, score.gain,
                   share(named, question), gain, tuple(mate.name for mate in mates), motion_of(question, mates[0]) if mates else '',
                   question.effect.against, {mate.name: _in_its_place(search, named, place, mate) for mate in mates})


def _in_its_place(search, named, place, mate):
    """Return parameter name -> (value, unit) of an effect that stands in the place of a finding."""
    used = search.used([*named[:place], mate, *named[place + 1:]])
    values = search.evidence.fit(used)[0]
    return {name: (float(values[used.index(k)]), mate.effect.unit_of(number))
            for number, (name, k) in enumerate(zip(mate.effect.param_names(), mate.parameters))}
