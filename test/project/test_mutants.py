"""The faults that `make mutants` puts into the code are still where they are declared; trying them takes half an hour and is not done here."""

from pathlib import Path

from mutants.declared import MUTANTS

ROOT = Path(__file__).parents[2]


def is_there(test):
    file, _, name = test.partition('::')
    return (ROOT / file).is_file() and (not name or f'def {name.partition("[")[0]}(' in (ROOT / file).read_text())


def test_every_declared_line_is_there_once_and_its_tests_exist():
    wrong = [mutant.name for mutant in MUTANTS if (ROOT / mutant.file).read_text().count(mutant.line) != 1 or mutant.line == mutant.fault
             or not all(map(is_there, mutant.tests))]
    assert not wrong
    assert len({mutant.name for mutant in MUTANTS}) == len(MUTANTS) >= 40
