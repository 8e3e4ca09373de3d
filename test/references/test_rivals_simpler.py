"""Of two explanations the simpler one, where misfit stays that nobody explains."""

from types import SimpleNamespace

import numpy as np
import pytest

from imu_calibration.effects.catalogue import CATALOGUE
from imu_calibration.references.turntable.selection import rivals as module
from imu_calibration.selection.questions import Question
from imu_calibration.selection.search import Score

ARMS, ARM, CUBE, GYROSCOPE = (
    Question(CATALOGUE.find(sensor, name), tuple(range(size)), size, name)
    for sensor, name, size in (
        ('accelerometer', 'accel_size_effect', 9),
        ('accelerometer', 'lever_arm', 3),
        ('accelerometer', 'accel_cubic', 3),
        ('gyroscope', 'gyro_quadratic', 3),
    )
)


class Search:
    """
    Arms of the three accelerometers explain a little more than one arm of all.

    A cube explains hardly anything.
    """

    def others(self, chosen):
        return [question for question in (ARM, CUBE, GYROSCOPE) if question not in chosen]

    def score(self, chosen, question):
        return Score(
            question, {ARMS: 900.0, ARM: 800.0, CUBE: 100.0, GYROSCOPE: 800.0}[question], 0.0, True
        )

    def allowed(self, chosen, question):
        return True


@pytest.mark.parametrize(
    'rest, share, least, told',
    [
        (50.0, 0.9, 0.002, ARM),  # nobody is sure that three arms do better
        (50.0, 0.9, 0.3, ARMS),  # they do
        (0.0, 0.9, 0.002, ARMS),  # nothing stays: likelihood is to be trusted
        (50.0, 0.5, 0.002, ARMS),  # one arm leaves too much
    ],
)
def test_the_simpler_of_two_is_told_where_a_rest_stays_and_the_residual_does_not_ask_for_more(
    monkeypatch, rest, share, least, told
):
    monkeypatch.setattr(
        module, 'gain_in_turn', lambda *args, **options: SimpleNamespace(ci95=(least, np.nan))
    )
    explained = SimpleNamespace(
        remaining_beside=lambda chosen, question: rest, share=lambda chosen, question: share
    )
    assert module.simpler(SimpleNamespace(search=Search(), explained=explained), [ARMS]) == [told]
