"""Every place that counts determined parameters has the count of the saved calibration."""

import pytest
from test_calibration_attacked import gathered, send

from imu_calibration.api.exporting import export_calibration
from imu_calibration.calibration.result import summary
from imu_calibration.document.files import read_calibration
from imu_calibration.document.outcome import missing, parameter_count, shortcomings
from imu_calibration.nodes.calibration_node import CalibrationNode
from imu_calibration.nodes.compensator_node import CompensatorNode
from imu_calibration.report.calibration_sections import calibration_report

from ros.live_station import TABLE
from worlds.live_sessions import make_session

pytestmark = pytest.mark.live
STATUS = ('calibration_node: calibration', 'compensator_node: compensation')


def test_nodes_files_exports_and_reports_count_the_same(bench, tmp_path):
    path = tmp_path / 'calibration.yaml'
    tolerances = tmp_path / 'tolerances.yaml'
    tolerances.write_text('gyroscope: {bias: 1.0e-7}\n')  # more than half a minute can give
    node = bench.start(
        CalibrationNode,
        {
            'table_file': str(TABLE),
            'save_file': str(path),
            'tolerances_file': str(tolerances),
            'diagnosis_period': 0.0,
        },
    )
    send(bench, *make_session(3, 50.0, seconds=30.0)[:2])
    gathered(bench, node)
    saved = bench.call('/calibration_node/save')
    calibration = read_calibration(path)
    count = parameter_count(calibration)
    assert {f'gyroscope.bias.{axis}' for axis in 'xyz'} <= set(count.lacking)
    assert not any(name.startswith('reference.') for name in count.lacking)
    assert missing(calibration) in saved.message
    assert missing(calibration) in shortcomings(calibration)

    # in words: the printed summary and the report
    words = f'{count.determined} of {count.requested}'
    assert any(line.startswith(words) for line in summary(node.worker.live.result))
    assert words in calibration_report(node.worker.live.result)
    exported = export_calibration(path, 'json', output=tmp_path / 'other.json')
    assert any(missing(calibration) in line for line in exported.lines)

    # the status begins with what is missing: only its first lines are shown
    bench.until(lambda: bench.shows(STATUS[0], missing(calibration)), 'the reason of the level')

    # as figures: /diagnostics of both nodes
    bench.start(CompensatorNode, {'calibration_file': str(path)})
    expected = [str(count.requested), str(len(count.lacking))]
    for status in STATUS:
        bench.until(
            lambda status=status: (
                [bench.figure(status, key) for key in ('parameters', 'not determined')] == expected
            ),
            status,
        )
