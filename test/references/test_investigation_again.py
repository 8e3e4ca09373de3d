"""
A further search is linearised only where it may remove nearly all of an excess.

It is linearised once for each choice.
"""

from types import SimpleNamespace

import pytest

from imu_calibration.references.turntable.selection import investigation
from imu_calibration.references.turntable.selection.investigation import (
    MAX_EXCESS_BEFORE,
    MAX_REMAINING_EXCESS,
)


@pytest.fixture
def looked_again(monkeypatch):
    """
    Return a function.

    Rest of the best choice before and after it is linearised -> (rest of the outcome, number of
    trials).
    """

    def look(before, after):
        best, trials = [SimpleNamespace(label='bent', name='bent')], []
        search = SimpleNamespace(run=lambda start: best, resolved=(), cost=len)
        problem = SimpleNamespace(search=search, questions=[])
        problem.asking_any_size = lambda: problem
        problem.explained = SimpleNamespace(remaining_excess=lambda chosen: before)
        first = SimpleNamespace(
            remaining_excess=100.0,
            problem=problem,
            chosen=[SimpleNamespace(label=label, name=label) for label in ('one', 'two')],
        )
        monkeypatch.setattr(investigation, 'best_pairs', lambda search: [])

        def settled(searched, problem, chosen):
            trials.append(chosen)
            return SimpleNamespace(remaining_excess=after)

        monkeypatch.setattr(investigation, '_settled', settled)
        outcome, tried = first, set()
        for any_size in (False, True):
            if outcome is first:
                of_size = SimpleNamespace(any_size=any_size)
                outcome = investigation._looked_again(outcome, of_size, tried)
        return outcome.remaining_excess, len(trials)

    return look


def test_a_choice_that_removes_nearly_all_is_adopted(looked_again):
    assert looked_again(100.0 * MAX_REMAINING_EXCESS, 0.0) == (0.0, 1)


def test_a_choice_that_leaves_much_is_not_linearised(looked_again):
    assert looked_again(100.0 * MAX_EXCESS_BEFORE, 0.0) == (100.0, 0)


def test_a_choice_is_linearised_once(looked_again):
    assert looked_again(100.0 * MAX_REMAINING_EXCESS, 100.0 * MAX_REMAINING_EXCESS) == (100.0, 1)
