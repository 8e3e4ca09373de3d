"""The faults that `make mutants` puts into the code are still where they are declared; trying them takes half an hour and is not done here."""

from pathlib import Path

from mutants.declared import MUTANTS

ROOT = Path(__file__).parents[1]


def test_every_declared_line_is_there_once_and_its_tests_exist():
    wrong = [mutant.name for mutant in MUTANTS if (ROOT / mutant.file).read_text().count(mutant.line) != 1 or mutant.line == mutant.fault
             or not all((ROOT / test).is_file() for test in mutant.tests)]
    assert not wrong
    assert len({mutant.name for mutant in MUTANTS}) == len(MUTANTS) >= 40
