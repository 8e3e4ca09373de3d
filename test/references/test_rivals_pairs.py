"""
All pairs at once: what no single effect shows, and what two that imitate each other do not prove.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.references.turntable.selection import investigation
from imu_calibration.references.turntable.selection.rivals import _Blocks, best_pairs
from imu_calibration.selection.evidence import Evidence
from imu_calibration.selection.questions import Question
from imu_calibration.selection.search import PENALTY, Search

NAMES = ('accel_quadratic', 'accel_cubic', 'accel_cross_product', 'accel_scale_asymmetry')
ASKED = [
    Question(CATALOGUE.find('accelerometer', name), (k + 1,), 1, name)
    for k, name in enumerate(NAMES)
]
N_ROWS = 600


def searched(signal, alike, size=1e-6):
    """
    Return the Search on rows with the baseline as the first column.

    The first two effects are alike, and each has a plausible size.
    """
    rng = np.random.default_rng(3)
    columns = rng.normal(size=(N_ROWS, 5))
    columns[:, 2] = (
        alike * columns[:, 1] + np.sqrt(1 - alike**2) * columns[:, 2] + 0.5 * columns[:, 0]
    )
    rows = np.column_stack(
        [columns / size, columns @ np.asarray(signal, float) + rng.normal(size=N_ROWS)]
    )
    total, parts = rows.T @ rows, np.array([part.T @ part for part in np.split(rows, 6)])
    return Search(
        Evidence(
            [],
            [],
            total=total,
            without=total - parts,
            prior_sd=np.full(5, 1e3),
            prior_mean=np.zeros(5),
        ),
        (0,),
        ASKED,
    )


def names(choice):
    return {question.name for question in choice}


def test_two_causes_that_hide_each_other_are_found_together():
    """Each alone removes a tenth of what both do, and no more than noise."""
    search = searched((1.0, 0.6, -0.6, 0.0, 0.0), 0.95)
    assert (
        not any(search.score([], question).significant for question in search.questions)
        and not search.run()
    )
    assert names(best_pairs(search)[0]) == set(NAMES[:2])
    assert names(search.run(best_pairs(search)[0])) == set(NAMES[:2])


def test_the_fall_of_a_pair_is_that_of_the_fit():
    search = searched((1.0, 0.6, -0.3, 0.2, 0.0), 0.6)
    ((net, *_),) = _Blocks(search).score([(0, 2)])
    fall = search.evidence.loss((0,)) - search.evidence.loss((0, 1, 3))
    assert net == pytest.approx(0.5 * fall - 2 * PENALTY)


def test_what_the_other_can_imitate_is_no_member():
    assert set(NAMES[:2]) not in map(names, best_pairs(searched((1.0, 5.0, -5.0, 0.0, 0.0), 0.999)))


def test_a_pair_of_which_one_does_nothing_does_not_survive():
    search = searched((1.0, 1.0, 0.0, 0.0, 0.0), 0.3)
    assert names(search.run(best_pairs(search)[0])) == {NAMES[0]}


def outcome(search, named, rest):
    explained = SimpleNamespace(remaining_excess=lambda chosen: 0.0)
    problem = SimpleNamespace(search=search, explained=explained)
    return SimpleNamespace(problem=problem, chosen=named, named=named, remaining_excess=rest)


@pytest.mark.parametrize(
    ('rest', 'remaining', 'found'),
    ((0.0, -1.0, set()), (50.0, -1.0, set(NAMES[:2])), (50.0, 10.0, set())),
    ids=('nothing to explain', 'a pair explains it', 'a pair leaves a fifth'),
)
def test_pairs_are_tested_for_a_remaining_excess(monkeypatch, rest, remaining, found):
    search, tested = searched((1.0, 0.6, -0.6, 0.0, 0.0), 0.95), []
    monkeypatch.setattr(
        investigation, 'best_pairs', lambda search: tested.append(search) or best_pairs(search)
    )
    monkeypatch.setattr(
        investigation,
        '_settled',
        lambda searched, problem, chosen: outcome(search, chosen, remaining),
    )
    setup = SimpleNamespace(any_size=False)
    again = investigation._looked_again(outcome(search, [], rest), setup, set())
    assert names(again.named) == found
    assert bool(tested) == bool(rest)  # their search takes long
