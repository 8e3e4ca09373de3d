"""The core speaks of what must hold; the command line and the nodes add what that is called there, and nothing that they do not have."""

import ast
import pickle
import re
from itertools import chain
from pathlib import Path

import numpy as np
import pytest

from imu_calibration.by_hand.status import Findings, hand_status
from imu_calibration.cli.hints import hints_of
from imu_calibration.cli.main import main
from imu_calibration.cli.parser import VERBS, make_parser
from imu_calibration.errors import KEYS, InputError, with_hint
from imu_calibration.nodes.hints import HINTS
from imu_calibration.samples import ImuSamples
from msg_adapters.write import write_session

ROOT = Path(__file__).resolve().parents[2]
EDGES = ('cli', 'nodes')


def core():
    """Syntax tree of each module that is no edge."""
    for folder in ('imu_calibration', 'msg_adapters'):
        for path in sorted((ROOT / folder).rglob('*.py')):
            if not (folder == 'imu_calibration' and path.relative_to(ROOT).parts[1] in EDGES):
                yield path, ast.parse(path.read_text())


def test_no_text_of_the_core_names_an_option_of_the_command_line():
    found = [(path.name, node.value) for path, tree in core() for node in ast.walk(tree)
             if isinstance(node, ast.Constant) and isinstance(node.value, str) and re.search(r'(?<![\w-])--[a-z][a-z-]+', node.value)]
    assert found == []


def test_every_key_is_known_and_every_known_one_is_used():
    used = {value.value for _, tree in core() for node in ast.walk(tree) if isinstance(node, ast.keyword) and node.arg == 'key'
            for value in ([node.value.body, node.value.orelse] if isinstance(node.value, ast.IfExp) else [node.value])
            if isinstance(value, ast.Constant) and value.value is not None}
    from msg_adapters.bag import KEYS as topics
    assert used | set(topics.values()) == set(KEYS)


def hints_and_options(verb):
    """The hints of a verb that got just what it requires, and the options that it has."""
    actions = make_parser(verb)._subparsers._group_actions[0].choices[verb]._actions
    given = [[*action.option_strings[:1], '1'] for action in actions if action.required]
    return hints_of(make_parser(verb).parse_args([verb, *chain.from_iterable(given)])), {name for action in actions for name in action.option_strings}


@pytest.mark.parametrize('verb', VERBS)
def test_a_verb_names_only_options_that_it_has(verb):
    hints, own = hints_and_options(verb)
    assert set(hints.values()) <= own
    assert ('--gravity' in own) == ('gravity' in hints)


def test_every_key_is_an_option_of_some_verb():
    assert {key for verb in VERBS for key in hints_and_options(verb)[0]} == set(KEYS)


@pytest.mark.parametrize('node', HINTS)
def test_a_node_names_only_parameters_and_topics_that_it_has(node):
    parameters = re.findall(r'^    (?:# )?(\w+):', (ROOT / f'config/{node}.yaml').read_text(), flags=re.M)
    source = (ROOT / f'imu_calibration/nodes/{node}.py').read_text()
    assert set(HINTS[node]) <= set(KEYS)
    for hint in HINTS[node].values():
        kind, name = hint.split()
        assert name.strip("'") in parameters if kind == 'parameter' else f"'{name}'" in source


def test_the_hint_follows_the_text_where_the_thing_has_a_name():
    assert with_hint('give the local gravity', 'gravity', {'gravity': '--gravity'}) == 'give the local gravity (--gravity)'
    assert with_hint('give the local gravity', 'gravity', {}) == with_hint('give the local gravity', None, {'gravity': '-'}) == 'give the local gravity'


def test_an_error_keeps_its_key_in_another_process_and_with_a_name():
    error = pickle.loads(pickle.dumps(InputError('choose one', key='imu_topic'))).named('bag_1')
    assert (type(error), str(error), error.key) == (InputError, 'bag_1: choose one', 'imu_topic')


def test_the_command_line_says_its_option(capsys, tmp_path):
    imu = ImuSamples(np.arange(20) * 10**7, np.tile([0.0, 0.0, 9.8], (20, 1)), np.zeros((20, 3)), 'imu')
    write_session(tmp_path / 'bag', imu, imu_topic='/imu/data_corrected')
    (tmp_path / 'calibration.yaml').write_text((ROOT / 'bags/sample_session/truth.yaml').read_text())
    assert main(['compensate', str(tmp_path / 'bag'), '--calibration', str(tmp_path / 'calibration.yaml'), '--output', str(tmp_path / 'out')]) == 1
    assert 'name the raw topic (--imu-topic)' in capsys.readouterr().err


def test_the_live_session_by_hand_says_the_parameter_of_its_node():
    class Solved:
        param_names, status, undetermined = ('accelerometer.matrix.xx',), ('weak',), ()
    found = Findings([slice(0, 9)] * 9, None, 9, 8, {}, 0.0)
    assert hand_status(found, Solved, gravity_unknown=True, step='', hints=HINTS['calibration_node']).message.endswith(
        "next: give the local gravity, which scales the accelerometer as a whole (parameter 'gravity')")
