"""
A verb is a module and its name in the list.

One made here is offered, run and refused like those that there are.
"""

import sys
from types import SimpleNamespace

import pytest

from imu_calibration.cli import parser
from imu_calibration.cli.main import main
from imu_calibration.core.errors import InputError


def add_arguments(arguments):
    """What the verb takes."""
    arguments.add_argument('bag', metavar='BAG')
    arguments.add_argument('--gravity', type=float)


def run(options):
    """Print what came, or ask for more."""
    if options.gravity is None:
        raise InputError('the local gravity must be known, none came; give it', key='gravity')
    print(f'{options.bag} at {options.gravity:g} m/s^2')
    return parser.VerbResult(3, {'bag': options.bag})


@pytest.fixture(autouse=True)
def weigh(monkeypatch):
    """Add the module and its name for the length of a test."""
    module = SimpleNamespace(
        EXAMPLES=('session.bag --gravity 9.81',), add_arguments=add_arguments, run=run
    )
    monkeypatch.setitem(sys.modules, 'imu_calibration.cli.weigh', module)
    monkeypatch.setitem(parser.VERBS, 'weigh', 'The weight of a bag.')


def test_it_runs_and_its_exit_code_is_that_of_the_program(capsys):
    assert main(['weigh', 'session.bag', '--gravity', '9.81']) == 3
    assert capsys.readouterr() == ('session.bag at 9.81 m/s^2\n', '')


def test_an_error_is_one_line_with_its_option(capsys):
    assert main(['weigh', 'session.bag']) == 1
    assert capsys.readouterr() == (
        '',
        'imu_calibration weigh: the local gravity must be known, none came; give it (--gravity)\n',
    )


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (['weigh'], 'the following arguments are required: BAG'),
        (['weigh', 'a', '--grvty', '1'], '--grvty'),
    ],
)
def test_wrong_arguments_are_refused_with_one_line(arguments, words, capsys):
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    error = capsys.readouterr().err
    assert ended.value.code == 1 and words in error and error.count('\n') == 1


def test_help_offers_it(capsys):
    with pytest.raises(SystemExit):
        main(['--help'])
    assert 'The weight of a bag.' in capsys.readouterr().out
