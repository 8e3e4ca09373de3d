"""
Nodes against other participants of the network.

Documents, files and names that were made to stop or deceive them.
"""

import os
from types import SimpleNamespace

import pytest
from std_msgs.msg import String

from imu_calibration.nodes.compensator_node import CompensatorNode
from imu_calibration.nodes.diagnostics import Complaints
from imu_calibration.nodes.inputs import latched_qos

from worlds.small_bags import hostile_calibration

pytestmark = pytest.mark.live


def test_a_document_of_nested_powers_is_refused_and_the_node_lives(bench):
    """29 kB took all memory of compensator_node, which accepts documents from the topic."""
    node = bench.start(CompensatorNode, {})
    bench.node.create_publisher(String, 'imu/calibration', latched_qos()).publish(
        String(data=hostile_calibration())
    )
    bench.until(lambda: node.refusal == 'column_expands', 'the refusal')
    assert node.adopted is None and not bench.call('/compensator_node/reload').success


def test_a_pipe_as_calibration_file_does_not_block_the_node(bench, tmp_path):
    os.mkfifo(tmp_path / 'calibration.yaml')
    node = bench.start(CompensatorNode, {'calibration_file': str(tmp_path / 'calibration.yaml')})
    answer = bench.call('/compensator_node/reload')
    assert (
        not answer.success
        and 'calibration.yaml' in answer.message
        and node.refusal == 'file_unreadable'
    )


def test_lines_of_the_log_have_no_control_characters():
    said = []
    Complaints(SimpleNamespace(warning=said.append)).event('frame \x1b[2Jimu\nERROR: all is well')
    assert said == ['frame ?[2Jimu?ERROR: all is well']
