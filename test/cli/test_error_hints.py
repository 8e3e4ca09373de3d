"""
The core speaks of what must hold.

The command line and the nodes add what that is called there, and nothing that they do not have.
"""

import ast
import pickle
import re
import subprocess
import sys
from functools import lru_cache
from itertools import chain
from pathlib import Path

import numpy as np
import pytest

from imu_calibration.cli.main import main
from imu_calibration.cli.parser import VERBS, make_parser
from imu_calibration.core.errors import ERROR_KEYS, InputError, with_hint
from imu_calibration.core.errors import REMEDY_VERBS as PROGRAMS
from imu_calibration.core.samples import ImuSamples
from imu_calibration.estimation.solution import COMMON_SCALE, GRAVITY, REMEDIES
from imu_calibration.nodes.lifecycle import HINTS
from imu_calibration.preprocessing.joint_checks import check_force
from imu_calibration.references.gravity.live_poses import PoseScan, hand_status
from msg_adapters.write import write_session

ROOT = Path(__file__).resolve().parents[2]
EDGES = ('cli', 'nodes')


@lru_cache(maxsize=1)
def core():
    """Path of each module that is no edge -> (its texts, the keys of its errors)."""
    paths = [
        path
        for folder in ('imu_calibration', 'msg_adapters')
        for path in sorted((ROOT / folder).rglob('*.py'))
        if not (folder == 'imu_calibration' and path.relative_to(ROOT).parts[1] in EDGES)
    ]
    return {path: texts_and_keys(ast.parse(path.read_text())) for path in paths}


def texts_and_keys(tree):
    """Return the texts of a module, and the keys of its errors."""
    nodes = list(ast.walk(tree))
    return (
        [
            node.value
            for node in nodes
            if isinstance(node, ast.Constant) and isinstance(node.value, str)
        ],
        {
            part.value
            for node in nodes
            if isinstance(node, ast.keyword) and node.arg == 'key'
            for part in ast.walk(node.value)
            if isinstance(part, ast.Constant) and part.value in ERROR_KEYS
        },
    )


def test_no_text_of_the_core_names_an_option_of_the_command_line():
    assert [
        (path.name, text)
        for path, (texts, _) in core().items()
        for text in texts
        if re.search(r'(?<![\w-])--[a-z][a-z-]+', text)
    ] == []


def test_no_text_of_the_core_tells_to_run_a_verb():
    """The user of a node has no recording; `errors.REMEDY_VERBS` are replaced there."""
    found = {
        (path.stem, verb)
        for path, (texts, _) in core().items()
        for text in texts
        if path.stem not in ('errors', 'page')
        for verb in re.findall(r"(?<!written by )'imu_calibration (\w+)'", text)
    }
    # To apply a calibration to a recording, beside compensator_node; in a document that `import`
    # writes.
    assert found == {('verdict', 'compensate'), ('loss', 'check')}


NAMED = {
    'setting': 'the text has the names of parameters of the node',
    'imu_topic': 'no readings are compared',
}
UNREACHABLE = {
    'calibration_node': {
        'exclude': 'of times in a recording',
        'increments': 'readings are converted in the driver, which the error names',
        'noise': 'no noise is compared',
        'accelerometer_unit': 'readings are converted in the driver, which the error names',
        'gyroscope_unit': 'readings are converted in the driver, which the error names',
        'anyway': 'no calibration is applied',
        'columns': 'no text log is read',
        'where': 'no text log is read',
        'force': 'results of verbs',
        'up': 'of transforms in a bag',
        'setting': NAMED['setting'],
        'calibration': 'no recording is replayed',
        'jobs': 'one process reads',
        'scheduler': 'one process reads',
    },
    'planner_node': {
        'increments': 'no readings are compared',
        'force': 'results of verbs',
        'noise': 'no noise is compared',
        'anyway': 'no calibration is applied',
        **NAMED,
        'accelerometer_unit': 'no readings are compared',
        'gyroscope_unit': 'no readings are compared',
        'gravity': 'no calibration is estimated',
        'calibration': 'with a plan for separation alone',
        'diagnose': 'no calibration is estimated',
        'inspect': 'no calibration is estimated',
        'temperature_topic': 'no recording is replayed',
        'frame_id': 'no recording is read',
        'exclude': 'no recording is read',
        'columns': 'no recording is read',
        'where': 'no recording is read',
        'jobs': 'no recording is read',
        'scheduler': 'no recording is read',
        'up': 'of transforms in a bag',
    },
    'simulator_node': {
        'up': 'of transforms in a bag',
        'force': 'results of verbs',
        'increments': 'no readings are compared',
        'temperature_topic': 'the simulated temperatures are known',
    },
    'compensator_node': {
        'increments': 'the calibration states the unit',
        'force': 'results of verbs',
        'axes': 'no calibration is exported',
        'accelerometer_unit': 'the calibration states the unit',
        'gyroscope_unit': 'the calibration states the unit',
        'allow_xacro': 'no robot description is read',
        'imu_link': 'no robot description is read',
        'up': 'of transforms in a bag',
    },
    'bag_player_node': {
        'increments': 'readings are played as they are',
        'allow_xacro': 'no robot description is read',
        'force': 'results of verbs',
    },
}
"""
Node -> {key of errors in the modules that it imports: reason why the node needs no name for it}.
"""


@pytest.mark.live
@pytest.mark.parametrize(
    'node',
    ['bag_player_node', 'calibration_node', 'compensator_node', 'planner_node', 'simulator_node'],
)
def test_every_key_that_can_reach_a_node_has_a_name_there(node):
    pytest.importorskip('rclpy')
    program = (
        f'import sys, imu_calibration.nodes.{node}; print(*[m.__file__ for m in'
        ' sys.modules.values() if getattr(m, "__file__", None)])'
    )
    files = set(
        subprocess.run(
            [sys.executable, '-c', program], cwd=ROOT, capture_output=True, text=True, check=True
        ).stdout.split()
    )
    reached = set().union(*(keys for path, (_, keys) in core().items() if str(path) in files))
    assert reached - set(HINTS.get(node, {})) == set(UNREACHABLE.get(node, {}))


def test_every_key_is_known_and_every_known_one_is_used():
    used = set().union(*(keys for _, keys in core().values()))
    from msg_adapters.bag import TOPIC_KEYS as topics

    assert used | set(topics.values()) == set(ERROR_KEYS)


def hints_and_options(verb):
    """The hints of a verb that got just what it requires, and the options that it has."""
    actions = make_parser(verb)._subparsers._group_actions[0].choices[verb]._actions
    given = [[*action.option_strings[:1], '1'] for action in actions if action.required]
    return make_parser(verb).parse_args([verb, *chain.from_iterable(given)]).hints(), {
        name for action in actions for name in action.option_strings
    }


@pytest.mark.parametrize('verb', VERBS)
def test_a_verb_names_only_options_that_it_has(verb):
    hints, own = hints_and_options(verb)
    assert set(hints.values()) <= own
    assert ('--gravity' in own) == ('gravity' in hints)


def test_every_key_is_an_option_of_some_verb():
    assert {key for verb in VERBS for key in hints_and_options(verb)[0]} == set(ERROR_KEYS) - set(
        PROGRAMS
    )


@pytest.mark.parametrize('node', HINTS)
def test_a_node_names_only_parameters_and_topics_that_it_has(node):
    parameters = re.findall(
        r'^    (?:# )?(\w+):', (ROOT / f'config/{node}.yaml').read_text(), flags=re.M
    )
    source = (ROOT / f'imu_calibration/nodes/{node}.py').read_text()
    assert set(HINTS[node]) <= set(ERROR_KEYS)
    assert set(HINTS[node]) >= ({'anyway'} if 'anyway' in parameters else set())
    for key, hint in HINTS[node].items():
        if key in PROGRAMS:
            service, verb = (
                re.findall(r'~/(\w+)', hint),
                re.findall(r"'imu_calibration (\w+)", hint),
            )
            assert (
                hint.count('{}') == 1
                and (service or verb)
                and set(verb) <= set(VERBS)
                and all(f"'{name}'" in source for name in service)
            )
            continue
        kind, name = hint.split()
        assert name.strip("'") in parameters if kind == 'parameter' else f"'{name}'" in source


def test_a_second_remedy_is_offered_only_where_it_exists():
    with pytest.raises(InputError) as refusal:
        check_force(1.0)
    error = refusal.value
    unit = {'accelerometer_unit': '--accelerometer-unit'}
    assert error.with_hint(unit).endswith('(--accelerometer-unit g)')
    for node in HINTS:
        assert 'state the unit' not in error.with_hint(HINTS[node]) and error.with_hint(
            HINTS[node]
        ).endswith('convert it in the driver')
    assert with_hint('find the cause', 'diagnose', HINTS['calibration_node']).startswith(
        'call ~/diagnose'
    )
    assert (
        with_hint('find the cause', 'diagnose', {})
        == "run 'imu_calibration diagnose' to find the cause"
    )
    assert (
        'consent'
        in with_hint('calibrate again', 'anyway', HINTS['compensator_node'])
        > with_hint('calibrate again', 'anyway', {})
    )


def test_the_hint_follows_the_text_where_the_thing_has_a_name():
    assert (
        with_hint('give the local gravity', 'gravity', {'gravity': '--gravity'})
        == 'give the local gravity (--gravity)'
    )
    assert (
        with_hint('give the local gravity', 'gravity', {})
        == with_hint('give the local gravity', None, {'gravity': '-'})
        == 'give the local gravity'
    )


def test_an_error_keeps_its_key_in_another_process_and_with_a_name():
    error = pickle.loads(pickle.dumps(InputError('choose one', key='imu_topic'))).named('bag_1')
    assert (type(error), str(error), error.key) == (InputError, 'bag_1: choose one', 'imu_topic')


def test_the_command_line_says_its_option(capsys, tmp_path):
    imu = ImuSamples(
        np.arange(20) * 10**7, np.tile([0.0, 0.0, 9.8], (20, 1)), np.zeros((20, 3)), 'imu'
    )
    write_session(tmp_path / 'bag', imu, imu_topic='/imu/data_corrected')
    (tmp_path / 'calibration.yaml').write_text(
        (ROOT / 'bags/sample_session/truth.yaml').read_text()
    )
    assert (
        main(
            [
                'compensate',
                str(tmp_path / 'bag'),
                '--calibration',
                str(tmp_path / 'calibration.yaml'),
                '--output',
                str(tmp_path / 'out'),
            ]
        )
        == 1
    )
    assert 'name the raw topic (--imu-topic)' in capsys.readouterr().err


def test_the_live_session_by_hand_says_the_parameter_of_its_node():
    class Solved:
        status_by_name = requested = {COMMON_SCALE: 'weak'}
        undetermined = ()

    found = PoseScan([slice(0, 9)] * 9, None, 9, 8, {}, 0.0)
    message = hand_status(found, Solved, step='', hints=HINTS['calibration_node']).message
    assert message.endswith(f"next: {REMEDIES[GRAVITY,]} (parameter 'gravity')")
