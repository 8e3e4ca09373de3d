"""What is said of each effect that was asked about."""

from imu_calibration.diagnosis.result import Candidate
from imu_calibration.diagnosis.search import FAMILY_WISE


def candidates_of(search, named):
    """Return every effect that a search asked about beside the findings, the strongest first; of a warm-up its best time constant."""
    found, mates, rows = {question.name for question in named}, {}, {}
    for question in named:
        for mate, _ in search.class_mates(named, question):
            mates.setdefault(mate.name, question.name)
    for question in search.questions:
        alone = search.score([], question)
        if question.name in rows and rows[question.name].gain_alone >= alone.gain:
            continue
        beside = None if question.name in found else search.score(named, question)
        rows[question.name] = Candidate(question.name, question.sensor, alone.gain, alone.p_value, beside and beside.gain,
                                        beside and beside.p_value, verdict_of(question.name, alone, beside, found, mates))
    return tuple(sorted(rows.values(), key=lambda row: -row.gain_alone))


def verdict_of(name, alone, beside, found, mates):
    """
    Return 'found', 'as good as NAME', 'not needed beside the findings', 'no evidence', or why the effect was refused.

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
        return 'refused: its size is impossible, or within the steps of the encoders'
    if beside is not None and beside.significant:
        return 'refused: it leaves most of the unexplained where it was'
    if alone.significant:
        return 'not needed beside the findings' if found else 'refused: it leaves most of the unexplained where it was'
    return 'no evidence'
