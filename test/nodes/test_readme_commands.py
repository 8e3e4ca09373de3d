"""
Every `ros2` command of docs/ros.md and of the README, as printed, from where they put the user.

~/ws with the package built in it.
"""

import os
import re
import shutil
import signal
import subprocess
import time

import numpy as np
import pytest
import yaml

import imu_calibration as imu
from imu_calibration.document.calibration_text import calibration_to_text
from imu_calibration.nodes.adoption import CompensatorSettings
from imu_calibration.nodes.lifecycle import UNKNOWN_PARAMETER

from ros.live_station import STAY_LOCAL, TABLE, free_domain
from ros.workspace import ROOT, sourced
from worlds.compensation_cases import random_calibration

pytestmark = [pytest.mark.slow, pytest.mark.live]
PATIENCE = 240.0
PLANNER = '/planner_node/'
"""What is asked of who drives; without a table it answers why nothing moves."""
WATCH = 'imu watch'
"""
It shows the present state, which after `reset` is that no messages were received yet. Any other
state of the streams is an answer: on a busy machine their stamps lie apart, or messages are lost.
"""
ANSWERS = {
    '/calibration_node/solve': 'success=True',
    '/calibration_node/save': '/ws/calibration.yaml',
    '/calibration_node/reset': 'restarted',
    'param describe': 'Fixed|settling',
    'param set': 'Set parameter successful',
    'topic echo /diagnostics': 'name: .*calibration_node: streams',
    'imu inspect': 'gravity reads 9.78',
    WATCH: r'streams +(?!no )\S',
    'ros2 doctor': 'checks passed',
    PLANNER: r'success=\w+, message=.\w+',
}
"""Beginnings of questions -> what stands in the answer."""


PAGES = ('docs/ros.md', 'README.md')


def commands():
    """
    Each command of the fenced blocks that calls ros2, once, its lines joined, without comments.
    """
    pages = '\n'.join((ROOT / name).read_text() for name in PAGES)
    blocks = re.findall(r'^```\w*\n(.*?)^```', pages, re.DOTALL | re.MULTILINE)
    lines = '\n'.join(blocks).replace('\\\n', ' ').splitlines()
    return list(
        dict.fromkeys(
            re.sub(r'\s+', ' ', line.split('  #')[0]).strip() for line in lines if 'ros2 ' in line
        )
    )


def starts(command):
    """Whether a command runs until it is ended."""
    return command.startswith(('ros2 run', 'ros2 launch'))


def nodes_of(command):
    """Names of the nodes that a command starts."""
    which = command.split()[3].removesuffix('.launch.py')
    return {
        'demo': ['simulator_node', 'calibration_node', 'compensator_node'],
        'calibrate': ['calibration_node'],
        'compensate': ['compensator_node'],
        'drive': ['calibration_node', 'planner_node'],
    }.get(which, [which])


@pytest.fixture(scope='module')
def home(tmp_path_factory, built, with_ros2):
    """(A home folder with ws in it, the environment of its shells)."""
    folder = tmp_path_factory.mktemp('home')
    environment = (
        with_ros2
        | STAY_LOCAL
        | {'HOME': str(folder), 'OMP_NUM_THREADS': '1', 'OPENBLAS_NUM_THREADS': '1'}
    )
    (folder / 'ws').mkdir()
    for name in ('install', 'src'):
        (folder / 'ws' / name).symlink_to(built / name)
    shutil.copy(TABLE, folder / 'ws' / 'table.yaml')
    (folder / 'ws' / 'calibration.yaml').write_text(calibration_to_text(random_calibration(1)))
    return folder, environment


class Terminal:
    """A shell that runs one command; leaving it is Ctrl-C."""

    def __init__(self, home, command, domain_id):
        folder, environment = home
        self.command, self.log = command, folder / f'terminal_{time.monotonic_ns()}.txt'
        with open(self.log, 'wb') as stream:
            self.process = subprocess.Popen(
                sourced(folder / 'ws', command),
                cwd=folder / 'ws',
                stdin=subprocess.DEVNULL,
                stdout=stream,
                stderr=stream,
                env=environment | {'ROS_DOMAIN_ID': str(domain_id)},
                start_new_session=True,
            )

    def shown(self):
        """What stands on it."""
        return self.log.read_text(errors='replace')

    def wait(self, *patterns, patience=PATIENCE):
        """Wait until all patterns stand on it."""
        end = time.monotonic() + patience
        while missing := [pattern for pattern in patterns if not re.search(pattern, self.shown())]:
            assert self.process.poll() is None and time.monotonic() < end, (
                f'{self.command}\nshows no {missing}, but\n{self.shown()}'
            )
            time.sleep(0.1)

    def interrupt(self):
        """Press Ctrl-C; return the exit code."""
        try:
            os.killpg(self.process.pid, signal.SIGINT)
            return self.process.wait(PATIENCE)
        except (subprocess.TimeoutExpired, ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
            return self.process.wait()


@pytest.fixture
def terminals(home):
    """Opens terminals of one domain."""
    domain_id, lock = free_domain()
    opened = []

    def open_one(command):
        opened.append(Terminal(home, command, domain_id))
        return opened[-1]

    yield open_one
    for terminal in opened:
        if terminal.process.poll() is None:
            terminal.interrupt()
    # Questions start the daemon, other commands do not.
    if not all(starts(terminal.command) for terminal in opened):
        subprocess.run(
            sourced(home[0] / 'ws', 'ros2 daemon stop'),
            cwd=home[0],
            env=home[1] | {'ROS_DOMAIN_ID': str(domain_id)},
            capture_output=True,
            timeout=60,
        )
    lock.close()


STARTING = [command for command in commands() if starts(command)]
THREE = STARTING[:3]
LESS = ('-p imu_rate:=25.0 -p joint_rate:=25.0', '-p diagnosis_period:=0.0', '')
"""Added to the three commands, so that a busy machine keeps up with four times real time."""


def test_the_readme_has_commands_and_asks_of_each_kind():
    assert len(STARTING) >= 10 and [nodes_of(command)[0] for command in THREE] == [
        'simulator_node',
        'calibration_node',
        'compensator_node',
    ]
    asked = [command for command in commands() if not starts(command)]
    assert asked and all(any(key in command for key in ANSWERS) for command in asked), asked


def lists(terminal, name):
    """Whether a command that ends by itself has listed a name."""
    assert terminal.process.wait(PATIENCE) == 0, terminal.shown()
    return name in terminal.shown().split()


def ask(terminals, command):
    """Ask a question of the README and look at the answer."""
    pattern = next(pattern for key, pattern in ANSWERS.items() if key in command)
    if 'echo' in command:
        asked = terminals(command)
        asked.wait(pattern)
        asked.interrupt()
    else:
        end = time.monotonic() + PATIENCE
        while True:
            asked = answered(terminals, command)
            assert asked.process.returncode == 0, asked.shown()
            if re.search(pattern, asked.shown()):
                break
            is_state = WATCH in command
            assert is_state and time.monotonic() < end, f'{command}\n{asked.shown()}'


def answered(terminals, command):
    """
    Return the terminal in which a question has ended.

    A service does not wait longer than 0.1 s until it knows the reader of who asks, and drops its
    answer then (ros2/rmw_fastrtps, pull request 704), which happens where all cores are busy: a
    person would press Ctrl-C and ask again.
    """
    for _ in range(3):
        asked = terminals(command)
        try:
            asked.process.wait(PATIENCE / 2)
            return asked
        except subprocess.TimeoutExpired:
            asked.interrupt()
    raise AssertionError(f'{command}\nis not answered, asked three times:\n{asked.shown()}')


@pytest.mark.long
def test_three_terminals_calibrate_and_compensate_and_answer(terminals, home):
    asked = [command for command in commands() if not starts(command) and PLANNER not in command]
    # What a question of files or of topics costs does not depend on nodes that run beside it.
    of_files = [command for command in asked if 'imu inspect' in command]
    of_topics = [command for command in asked if 'ros2 doctor' in command]
    for command in of_files:
        ask(terminals, command)
    simulator, calibrator, compensator = map(
        terminals, (f'{command} {less}'.strip() for command, less in zip(THREE, LESS, strict=True))
    )
    calibrator.wait('/imu/data_raw from /simulator_node', 'JointState .*/simulator_node')
    # The daemon that ros2 starts finds the nodes after a while; each question costs half a second.
    while not lists(terminals('ros2 node list'), '/calibration_node'):
        time.sleep(1.0)
    for command in asked:
        if command not in of_files + of_topics:
            ask(terminals, command)
    compensator.wait('[0-9a-f]{12} .*/imu/calibration|/imu/calibration was refused')
    assert 'decision:' in (home[0] / 'ws' / 'calibration.yaml').read_text()
    press_ctrl_c(calibrator, compensator)
    for command in of_topics:
        ask(terminals, command)
    press_ctrl_c(simulator)


def press_ctrl_c(*ended):
    """Press Ctrl-C in some terminals, whose nodes end without an error."""
    for terminal in ended:
        assert terminal.interrupt() == 0, terminal.shown()
        assert 'Traceback' not in terminal.shown(), terminal.shown()


BY_HAND = next(command for command in STARTING if 'calibrate.launch' in command)
COMPENSATE = next(command for command in STARTING if 'corrected:=' in command)
"""Both are started with further arguments by another test, the others here."""
FURTHER = [command for command in STARTING[3:] if command not in (BY_HAND, COMPENSATE)]


@pytest.mark.long
@pytest.mark.parametrize('command', FURTHER)
def test_what_runs_starts_as_printed_and_ends_on_ctrl_c(terminals, command):
    terminal = terminals(command)
    terminal.wait(*(rf'\[{name}\]: ' for name in nodes_of(command)))
    if 'gravity' in command:
        terminal.wait('by hand')
    elif 'calibration_node --' in command:
        terminal.wait('/table.yaml .*outer, middle, inner')
    elif 'calibration.yaml' in command:
        terminal.wait('calibration [0-9a-f]{12} ')
    elif 'drive.launch' in command:
        for question in commands():
            if PLANNER in question:
                ask(terminals, question)
    elif 'bag_player' in command:
        terminal.wait('/sample_session .*10 .*/imu/data_raw')
    press_ctrl_c(terminal)
    assert UNKNOWN_PARAMETER not in terminal.shown(), terminal.shown()


def dumped(terminals, launched, node):
    """
    Parameters of a node, requested until it answers or its launch ends.

    The command fails while it does not see the node, and prints one line without failing where the
    services of the node are not found in 5 s (ros2param 0.32).
    """
    while launched.process.poll() is None:
        answer = answered(terminals, f'ros2 param dump {node}').shown()
        document = re.search(rf'(?ms)^{node}:$.*', answer)
        if document:
            return yaml.safe_load(document[0])[node]['ros__parameters']
    raise AssertionError(launched.shown())


class Ended:
    """A terminal whose command shows a text and has ended, or runs on."""

    def __init__(self, text, returncode=0):
        self.text, self.process, self.returncode = text, self, returncode
        self.wait = lambda patience: returncode

    def shown(self):
        return self.text

    def poll(self):
        return self.returncode


def test_parameters_are_requested_until_the_node_answers():
    answers = [
        Ended('Node not found', 1),
        Ended(''),
        Ended('Wait for service timed out waiting for parameter services for node /n'),
        Ended('/n:\n  ros__parameters:\n    gravity: 9.8\n'),
    ]
    assert dumped(lambda _: answers.pop(0), Ended('', None), '/n') == {'gravity': 9.8}
    assert answers == []
    with pytest.raises(AssertionError, match='ended'):
        dumped(None, Ended('ended', 1), '/n')


@pytest.mark.long
def test_launch_arguments_are_parameters_of_the_node_which_is_started_again(terminals, home):
    """
    With the real launch, as printed and with further arguments.

    An argument that is not given keeps the default of the node.
    """
    workspace = home[0] / 'ws'
    rng = np.random.default_rng(1)
    still = {
        'time': 0.01 * np.arange(6000),
        'force': [0.0, 0.0, 9.81] + 0.01 * rng.normal(size=(6000, 3)),
        'rate': 1e-3 * rng.normal(size=(6000, 3)),
    }
    imu.noise(**still).save(workspace, report=False)
    noise = str(workspace / 'noise.yaml')
    launched = terminals(
        f'{COMPENSATE} respawn:=true anyway:=true gravity:=9.78 noise_file:={noise}'
    )
    launched.wait(r'calibration \w+ from .* adopted')
    found = dumped(terminals, launched, '/compensator_node')
    given = {name: found[name] for name in ('anyway', 'gravity', 'noise_file')}
    assert given == {'anyway': True, 'gravity': 9.78, 'noise_file': noise}
    assert found['adopt'] == CompensatorSettings().adopt

    # Its end is followed by another start.
    started = r'process started with pid \[(\d+)\]'
    os.kill(int(re.search(started, launched.shown())[1]), signal.SIGKILL)
    launched.wait(f'(?s){started}.*{started}.* adopted')
    press_ctrl_c(launched)

    launched = terminals(f'{BY_HAND} gravity:=9.8')
    launched.wait('by hand')
    assert dumped(terminals, launched, '/calibration_node')['gravity'] == 9.8
    press_ctrl_c(launched)
    assert UNKNOWN_PARAMETER not in launched.shown(), launched.shown()
