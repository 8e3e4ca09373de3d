"""
Every fault that `make mutants` puts into the code has its place.

Renamed variables and moved functions do not matter.
"""

import ast
from pathlib import Path

import pytest
from mutants.declared import MUTANTS
from mutants.mutation import NotFound, matches, mutated, path_of_test

ROOT = Path(__file__).resolve().parents[2]
LONGEST_PATTERN = 60
"""Characters; a longer pattern quotes code, which a rewrite changes, in place of naming a node."""
CODE = """
LIMIT, OTHER = 3.0, 4.0


class Judge:
    MOST = 5

    def judge(self, values, least):
        def far(value):
            return value > least + LIMIT
        if not values:
            return None
        return [value for value in values if far(value) and value < self.MOST]
"""


def fits_once(mutant):
    fitting = matches(ROOT, mutant.place, mutant.pattern, mutant.fault)
    return len(fitting) == 1 and ast.dump(fitting[0][1]) != ast.dump(fitting[0][2])


def test_every_fault_has_one_place_and_its_tests_exist():
    assert [mutant.name for mutant in MUTANTS if not fits_once(mutant)] == []
    assert all(path_of_test(ROOT, test) for mutant in MUTANTS for test in mutant.tests)
    assert len({mutant.name for mutant in MUTANTS}) == len(MUTANTS)
    assert max(len(mutant.pattern) for mutant in MUTANTS) <= LONGEST_PATTERN


@pytest.fixture
def tree(tmp_path):
    """Return a function that writes a module and gives its root."""

    def written(text, file='imu_calibration/judge.py'):
        place = tmp_path / str(len(list(tmp_path.iterdir()))) / file
        place.parent.mkdir(parents=True)
        place.write_text(text)
        return place.parents[len(Path(file).parts) - 1]

    return written


@pytest.mark.parametrize(
    ('place', 'pattern', 'fault', 'old', 'new'),
    (
        ('LIMIT', '...', '30.0', '3.0, 4.0', '30.0, 4.0'),
        ('Judge.MOST', '5', '50', '5', '50'),
        ('Judge.judge.far', '_1 > _2 + LIMIT', '_1 > LIMIT', 'least + LIMIT', 'LIMIT'),
        ('Judge.judge', '... and _1 < self.MOST', '...', ' and value < self.MOST', ''),
        (
            'Judge.judge',
            'if not _1: ...',
            'pass',
            'if not values:\n            return None',
            'pass',
        ),
    ),
)
def test_a_fault_is_put_in_by_structure(tree, place, pattern, fault, old, new):
    assert CODE.count(old) == 1
    file, text = mutated(tree(CODE), place, pattern, fault)
    assert file.name == 'judge.py' and ast.dump(ast.parse(text)) == ast.dump(
        ast.parse(CODE.replace(old, new))
    )
    renamed = CODE.replace('value', 'reading').replace('least', 'smallest')
    file, text = mutated(tree(renamed, 'msg_adapters/deep/er.py'), place, pattern, fault)
    assert (
        file.name == 'er.py'
        and text.replace('reading', 'value').replace('smallest', 'least')
        == ast.unparse(ast.parse(CODE.replace(old, new))) + '\n'
    )


@pytest.mark.parametrize(
    ('place', 'pattern', 'fault'),
    (
        ('Judge.judge', '_1', 'None'),
        ('Judge.judge', 'far(LIMIT)', 'True'),
        ('Judge.judge', '_1 < self._2', 'True'),
        ('Judge.judge', '_1 > _1 + LIMIT', 'True'),
        ('judge', 'far(_1)', 'True'),
        ('OTHER', '4.0', '4.0'),
    ),
)
def test_a_pattern_that_fits_nothing_or_more_than_one_node_is_refused(tree, place, pattern, fault):
    with pytest.raises(NotFound):
        mutated(tree(CODE), place, pattern, fault)
