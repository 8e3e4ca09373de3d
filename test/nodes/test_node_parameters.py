"""
The parameter files in config/ are the declarations of the nodes, with their defaults.

``make config`` writes them.
"""

import difflib
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

from imu_calibration.core.settings import describe, setting
from imu_calibration.nodes import NODE_NAMES
from imu_calibration.nodes.lifecycle import settings_of, value_text
from tools.parameter_files import main, rendered

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize('node', NODE_NAMES)
def test_parameter_file_is_the_declaration(node):
    written, declared = (ROOT / 'config' / f'{node}.yaml').read_text(), rendered(node)
    difference = '\n'.join(
        difflib.unified_diff(
            written.splitlines(), declared.splitlines(), 'written', 'declared', lineterm=''
        )
    )
    assert not difference, f'run make config\n{difference}'


@pytest.mark.parametrize('node', NODE_NAMES)
def test_yaml_gives_the_defaults_back(node):
    values = yaml.safe_load(rendered(node))['/**']['ros__parameters'] or {}
    defaults = {
        item.name: item.default
        for group in settings_of(node)
        for item in describe(group)
        if not item.session
    }
    assert {
        name: tuple(value) if isinstance(value, list) else value for name, value in values.items()
    } == defaults
    assert [type(value) for value in values.values()] == [
        list if isinstance(value, tuple) else type(value) for value in defaults.values()
    ]


@pytest.mark.parametrize('value', [1e-5, 1.5e-7, 0.1, 20.0, 1e22, True, 3, '', 'a: b', (0.0, 1e-9)])
def test_values_keep_their_type(value):
    read = yaml.safe_load(value_text(value))
    assert (tuple(read) if isinstance(value, tuple) else read) == value and isinstance(
        read, (type(value), list)
    )


def test_make_config_writes_what_is_missing_and_leaves_the_rest(tmp_path, capsys):
    for node in NODE_NAMES[1:]:
        (tmp_path / f'{node}.yaml').write_text(rendered(node))
    main(tmp_path)
    assert f'{tmp_path}/{NODE_NAMES[0]}.yaml' in capsys.readouterr().out
    assert (tmp_path / f'{NODE_NAMES[0]}.yaml').read_text() == rendered(NODE_NAMES[0])


def test_a_new_setting_is_a_parameter_and_a_line_of_its_file(monkeypatch):
    """Nothing but the declaration is touched."""
    node_module = pytest.importorskip('imu_calibration.nodes.compensator_node')
    from imu_calibration.nodes.lifecycle import declare_parameters

    @dataclass(frozen=True)
    class Wider(node_module.CompensatorSettings):
        """With one more setting."""

        patience: float = setting(2.5, 's', 'how long to wait', (0.0, 9.0), 'it waits too long')

    class Bench:
        def declare_parameter(self, name, default, descriptor):
            return SimpleNamespace(
                value=3.5 if name == 'patience' else default, descriptor=descriptor
            )

        def add_on_set_parameters_callback(self, answer):
            self.answer = answer

    monkeypatch.setattr(node_module, 'CompensatorSettings', Wider)
    assert (
        '    # how long to wait [s], 0 to 9. When wrong: it waits too long\n    patience: 2.5\n'
        in rendered('compensator_node')
    )
    assert declare_parameters(Bench(), Wider).patience == 3.5
