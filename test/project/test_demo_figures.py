"""The comparison of the demonstration with the README notices other figures and missing ones."""

import pytest

from tools.demo_figures import NAMES, README, differences

LOG = """
        accelerometer      gyroscope  velocity after 50 s  position after 50 s
before        {} mg    {} deg/s             28.7 m/s                501 m
after        {} mg  {} deg/s             1.00 m/s               17.0 m
"""
STATED = (5.64, 0.306, 0.119, 0.0079)


def test_the_figures_of_the_readme_agree_with_themselves():
    assert differences(README.read_text(), LOG.format(*STATED)) == []


@pytest.mark.parametrize('column, name', list(enumerate((NAMES[0], NAMES[2], NAMES[1], NAMES[3]))))
def test_a_figure_that_differs_by_more_than_five_percent_is_named(column, name):
    figures = list(STATED)
    figures[column] *= 1.06
    lines = differences(README.read_text(), LOG.format(*figures))
    assert len(lines) == 1 and lines[0].startswith(name)


def test_missing_figures_are_an_error():
    with pytest.raises(ValueError):
        differences(README.read_text(), 'Traceback')
    with pytest.raises(ValueError):
        differences('', LOG.format(*STATED))
