"""Every command of docs/own-effects.md runs as printed."""

import re
import shlex
from pathlib import Path

import pytest
import yaml

from imu_calibration.cli.main import main
from imu_calibration.document.files import read_calibration

from worlds.candidates import searching_few
from worlds.no_reports import without_reports

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / 'docs' / 'own-effects.md'
FEWER_SAMPLES = ['--imu-rate', '25', '--joint-rate', '25']
"""Added to the simulation: the motion determines the effect at any rate."""


@pytest.mark.long
def test_the_commands_of_the_page_run_in_its_order(tmp_path, monkeypatch, capsys):
    pytest.importorskip('foxglove')
    (tmp_path / 'my_effects.yaml').write_bytes(
        (ROOT / 'config' / 'effects_example.yaml').read_bytes()
    )
    monkeypatch.chdir(tmp_path)
    parts = re.split(r'^```\w*\n?', PAGE.read_text(), flags=re.MULTILINE)
    lines = [line for block in parts[1::2] for line in block.splitlines()]
    lines = [line for line in lines if line.startswith('imu_calibration ')]
    assert len(lines) == 7
    printed = {}
    for line in lines:
        program, *arguments = shlex.split(line)
        assert program == 'imu_calibration'
        if '--profile' in arguments:
            arguments += FEWER_SAMPLES
        with without_reports():
            assert main(searching_few(arguments, 'none')) in (0, 3), line
        printed[line] = capsys.readouterr().out
    result = read_calibration(tmp_path / 'result')
    assert (result.provenance['serial'], result.provenance['operator']) == ('A-17', 'Kim')
    assert ('gyroscope', 'gyro_scale_by_force') in result.model.slices
    later = read_calibration(tmp_path / 'later')
    for sensor in ('accelerometer', 'gyroscope'):
        assert later.proof[sensor].earlier.after > 0
    overlay = (tmp_path / 'overlay.mcap').read_bytes()
    for topic in (b'/overlay/gyroscope/x', b'/residual/gyroscope', b'/residual_spectrum/gyroscope'):
        assert topic in overlay
    assert (tmp_path / 'parameters.mcap').stat().st_size > 0


def test_the_definition_on_the_page_is_that_of_the_example():
    (text,) = re.findall(r'^```yaml\n(.*?)^```$', PAGE.read_text(), re.DOTALL | re.MULTILINE)
    example = yaml.safe_load((ROOT / 'config' / 'effects_example.yaml').read_text())
    ((name, shown),) = yaml.safe_load(text)['effects'].items()
    assert shown.items() <= example['effects'][name].items()
