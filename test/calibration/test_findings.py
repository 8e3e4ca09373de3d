"""
A chosen effect as a finding.

The same words, mates and candidates whether the search ran on a table or by hand.
"""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from imu_calibration.calibration.diagnosis.diagnosis_result import (
    ParameterEstimate,
    residual_mapping,
)
from imu_calibration.calibration.diagnosis.diagnosis_workflow import beyond_lines
from imu_calibration.calibration.diagnosis.findings import (
    DISAGREED,
    IMPOSSIBLE,
    LEAVES_MOST,
    UNCERTAIN,
    candidates_of,
    finding,
    sentence,
)
from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.effects.sensor_model import SensorModel
from imu_calibration.estimation.solution import Solution
from imu_calibration.selection import search as forward
from imu_calibration.selection.gain import Gain
from imu_calibration.selection.questions import Question
from imu_calibration.selection.search import Score
from imu_calibration.selection.unexplained import Unexplained

FIRST, SECOND, MATE, OTHER = (
    Question(CATALOGUE.find('accelerometer', name), (k,), 3, name)
    for k, name in enumerate(
        ('accel_quadratic', 'accel_cubic', 'accel_scale_asymmetry', 'accel_cross_product')
    )
)
GAIN = Gain('accelerometer', 'samples', 2.0, 1.0, (0.4, 0.6), 5)


@dataclass
class Search:
    """
    What a search says of three questions.

    The mate would do in the place of both findings, a little better in the second's.
    """

    questions: tuple = (FIRST, SECOND, MATE, OTHER)

    def score(self, chosen, question):
        size = {FIRST: 90.0, SECOND: 60.0, MATE: 50.0, OTHER: 1.0}[question] / (1 + len(chosen))
        return Score(question, size, np.exp(-size), True)

    def confounded(self, chosen, question):
        return {FIRST: [(MATE, 3.0)], SECOND: [(MATE, 1.0), (OTHER, 7.0)]}[question]

    def indices(self, chosen):
        return tuple(k for question in chosen for k in question.parameters)

    def estimate(self, chosen, question):
        return 10.0 * np.array(question.parameters) + sum(self.indices(chosen)), np.ones(
            len(question.parameters)
        )


@pytest.fixture(scope='module')
def solution():
    """Return the solution of a model with both findings."""
    model = SensorModel(accelerometer=('bias', 'matrix', FIRST.name, SECOND.name))
    size = len(model.param_names)
    return Solution(
        model,
        np.linspace(0.1, 1.0, size),
        {'noise': 1e-4 * np.eye(size)},
        np.zeros(size, bool),
        {},
        {},
        np.eye(size),
        {},
    )


def test_an_effect_as_good_as_two_findings_belongs_to_the_first():
    rows = {row.effect: row for row in candidates_of(Search(), [FIRST, SECOND])}
    assert rows[MATE.name].verdict == f'as good as {FIRST.name}'
    assert rows[OTHER.name].verdict == f'as good as {SECOND.name}'
    assert [rows[q.name].verdict for q in (FIRST, SECOND)] == ['found', 'found']


def test_a_finding_names_its_own_mates_and_the_motion_against_the_best_of_them(solution):
    asked = []

    def motion_of(question, mate):
        asked.append((question, mate))
        return 'turn it over'

    made = [
        finding(
            Search(),
            [FIRST, SECOND],
            place,
            solution=solution,
            share=lambda named, q: 0.9,
            gain_of=lambda place: GAIN,
            motion_of=motion_of,
        )
        for place in (0, 1)
    ]
    assert [f.indistinguishable_from for f in made] == [(MATE.name,), (MATE.name, OTHER.name)]
    assert asked == [(FIRST, MATE), (SECOND, MATE)]
    assert made[1].heldout_gain == 30.0 and made[1].separating_motion == 'turn it over'
    # MATE is parameter 2 beside SECOND (1) in the place of FIRST, and beside FIRST (0) in that of
    # SECOND
    assert [f.sizes_of_mates[MATE.name] for f in made] == [
        {'accelerometer.accel_scale_asymmetry.x': (size, '1')} for size in (23.0, 22.0)
    ]
    assert set(made[1].parameters) == {f'accelerometer.accel_cubic.{axis}' for axis in 'xyz'}


@pytest.mark.parametrize('agree, verdict', [(True, LEAVES_MOST), (False, DISAGREED)])
def test_what_is_not_named_for_its_windows_disagree_is_not_said_to_leave_the_rest(agree, verdict):
    asked = []
    rows = {
        row.effect: row.verdict
        for row in candidates_of(Search(), [], agree=lambda *those: asked.append(those) or agree)
    }
    assert rows[FIRST.name] == verdict and ([FIRST], FIRST) in asked


def test_what_explains_much_but_leaves_most_is_said():
    """
    An effect that explains thousands of nats is not passed over in silence.

    This holds also when the effect may not be named.
    """
    from imu_calibration.calibration.diagnosis.diagnosis_result import Candidate
    from imu_calibration.calibration.diagnosis.diagnosis_workflow import nothing_named

    class LagHypothesis:
        candidates = (Candidate('time_offset', 'reference', 4321.0, 0.0, 4321.0, 0.0, LEAVES_MOST),)

    assert all(word in nothing_named(LagHypothesis) for word in ('time_offset', '4321 nats'))
    LagHypothesis.candidates = (
        Candidate('gyro_delay', 'gyroscope', 163.0, 0.0, 163.0, 0.0, DISAGREED),
    )
    assert all(word in nothing_named(LagHypothesis) for word in ('gyro_delay', '163 nats'))
    LagHypothesis.candidates = (
        Candidate('time_offset', 'reference', 3.0, 1e-4, 3.0, 1e-4, LEAVES_MOST),
    )
    assert 'time_offset' not in nothing_named(LagHypothesis)  # not significant


@pytest.mark.parametrize('verdict', [LEAVES_MOST, DISAGREED, IMPOSSIBLE, UNCERTAIN])
def test_the_strongest_refused_effect_is_reported_for_each_reason(verdict):
    """The gain in addition to the findings decides, not the gain alone."""
    from imu_calibration.calibration.diagnosis.diagnosis_result import Candidate
    from imu_calibration.calibration.diagnosis.diagnosis_workflow import strongest_refused

    class WithFinding:
        candidates = (
            Candidate('lever_arm', 'accelerometer', 900.0, 0.0, None, None, 'found'),
            Candidate('time_offset', 'reference', 800.0, 0.0, 5.0, 1e-6, verdict),
            Candidate('gyro_delay', 'gyroscope', 163.0, 0.0, 40.0, 0.0, verdict),
        )

    assert strongest_refused(WithFinding).effect == 'gyro_delay'


@pytest.mark.parametrize(('sigma', 'by_structure'), [(-2.2, True), (4.9, True), (5.1, False)])
def test_a_residual_below_the_limit_is_significant_by_its_structure_only(sigma, by_structure):
    nothing = np.zeros((1, 3))
    rest = Unexplained(True, 1e-3, sigma, None, 0.0, nothing, nothing, axes=('y',))
    assert rest.by_structure == by_structure
    assert not replace(rest, significant=False).by_structure
    assert all('gyroscope' in line for line in beyond_lines('gyroscope', rest))
    assert residual_mapping('gyroscope', rest, None)['sigma'] == (None if by_structure else sigma)


def test_an_effect_that_the_calibration_refused_has_that_reason():
    rows = {
        row.effect: row.verdict
        for row in candidates_of(
            Search(), [], agree=lambda chosen, question: True, withdrawn=[FIRST]
        )
    }
    assert rows[FIRST.name] == UNCERTAIN
    assert rows[SECOND.name] == LEAVES_MOST


class LagsAndDelay(forward.Evidence):
    """
    A delay is a lag of each sensor: two of the three cost the same but for rounding.

    What is better makes a lag negative.
    """

    def __init__(self, better=0.0):
        super().__init__(
            [],
            [],
            total=np.zeros((4, 4)),
            without=np.zeros((0, 4, 4)),
            prior_sd=np.ones(3),
            prior_mean=np.zeros(3),
        )
        self.better = better

    def heldout(self, used):
        return 1e6 + {(0,): 300.0, (0, 1): 0.0, (1, 2): -4e-6 - self.better, (0, 2): -8e-6}.get(
            tuple(sorted(used)), 1e6
        )

    def p_value(self, smaller, larger):
        return 0.0

    def heldout_parts(self, used):
        return {
            sensor: np.full((2, 3), self.heldout(used) / 12)
            for sensor in ('accelerometer', 'gyroscope')
        }

    def fit(self, used, number=None):
        return np.array(
            [
                -0.01 if self.better and (k == 1 and 2 in used or k == 2 and 0 in used) else 0.01
                for k in used
            ]
        ), 1e-12 * np.eye(len(used))

    loss = heldout


@pytest.mark.parametrize('better', [0.0, 50.0])
def test_rounding_replaces_nothing_and_neither_does_what_makes_another_lag_negative(better):
    effects = (
        CATALOGUE.find('reference', 'time_offset'),
        CATALOGUE.find('gyroscope', 'gyro_bandwidth'),
        CATALOGUE.find('accelerometer', 'accel_bandwidth'),
    )
    delay, gyroscope, accelerometer = asked = [
        Question(effect, (k,), 1, effect.name) for k, effect in enumerate(effects)
    ]
    found = forward.Search(LagsAndDelay(better), (), asked).reconsidered([delay, gyroscope])
    assert found == [delay, gyroscope]


@pytest.mark.parametrize('after, words', [(1.0, 'falls by 50 %'), (1.9998, 'falls by 0.01 %')])
def test_a_small_gain_is_not_told_as_none(after, words):
    gain = Gain('accelerometer', 'samples', 2.0, after, (0.0, 0.6), 5)
    estimate = ParameterEstimate(1e-5, 1e-6, '(m/s^2)^-1')
    assert sentence(FIRST.effect, {'accelerometer.accel_quadratic.x': estimate}, gain).endswith(
        f'{words}.'
    )
