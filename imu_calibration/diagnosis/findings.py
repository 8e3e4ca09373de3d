"""One chosen effect as a finding, the same on a table and by hand."""

from collections.abc import Callable, Sequence

from imu_calibration.calibration.plausibility import beyond_known
from imu_calibration.diagnosis.result import Finding, parameters_of
from imu_calibration.diagnosis.sentences import sentence
from imu_calibration.estimation.solution import Solution
from imu_calibration.selection.questions import Question
from imu_calibration.selection.search import Search


def finding(search: Search, named: Sequence[Question], place: int, *, solution: Solution, share: Callable, gain_of: Callable,
            motion_of: Callable, shows: Callable = lambda place, mate, gain: True, rivals: Sequence[Question] = ()) -> Finding:
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
        ``shows(place, mate, gain)``: whether an effect in the place of this one shows in the sensor that shows this one.
    rivals : sequence of Question
        Effects known to do nearly as well in its place.

    """
    question = named[place]
    score = search.score([q for q in named if q is not question], question)
    gain, explained = gain_of(place), share(named, question)
    if question.effect.key in solution.model.slices:
        parameters = parameters_of(solution, question.sensor, question.name)
    else:
        parameters = fitted(search, named, question)
    text = sentence(question.effect, parameters, gain)
    if score.implausible:
        text += f' It {beyond_known(explained, question.sensor)}. It is in no model unless requested.'
    mates = [*rivals, *(mate for mate, _ in search.class_mates(named, question)
                        if mate.name not in {rival.name for rival in rivals} and shows(place, mate, gain))]
    return Finding(question.name, question.sensor, text, parameters, score.p_value, score.gain, explained, gain,
                   tuple(mate.name for mate in mates),
                   motion_of(question, mates[0]) if mates else '', question.effect.against,
                   {mate.name: _in_its_place(search, named, place, mate) for mate in mates}, score.implausible)


def _in_its_place(search, named, place, mate):
    """Return parameter name -> (value, unit) of an effect that replaces a finding."""
    found = fitted(search, [*named[:place], mate, *named[place + 1:]], mate)
    return {name: (value, unit) for name, (value, _, unit) in found.items()}


def fitted(search: Search, named: Sequence[Question], question: Question) -> dict[str, tuple[float, float, str]]:
    """Return parameter name -> (value, sd, unit) of a chosen effect as the search fitted it."""
    names = question.effect.param_names()
    return {name: (float(value), float(sd), question.effect.unit_of(k))
            for k, (name, value, sd) in enumerate(zip(names, *search.estimate(named, question)))}
