"""A constant of a module has a name of its own in the whole product, so that the name states quantity and purpose."""

import ast
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PLUG_INS = {'EXAMPLES': 'imu_calibration/cli/*.py', 'TARGETS': 'imu_calibration/document/exports/targets/*.py'}
"""Names that each module of a folder defines by design."""


def constants(tree):
    """Yield (upper-case name, whether it is an alias of a member of an enumeration) of what a module defines."""
    classes = {node.name for node in tree.body if isinstance(node, ast.ClassDef)}
    for node in tree.body:
        if isinstance(node, (ast.Assign, ast.AnnAssign)) and node.value is not None:
            for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                for name in (part.id for part in ast.walk(target) if isinstance(part, ast.Name) and part.id.isupper()):
                    yield name, is_member(name, node.value, classes)


def is_member(name, value, classes):
    """Return whether a value has the member of that name: `Phase`, a class of the module that is unpacked, or `Phase.STILL`."""
    if isinstance(value, ast.Tuple):
        return any(is_member(name, part, ()) for part in value.elts)
    return isinstance(value, ast.Attribute) and value.attr == name or isinstance(value, ast.Name) and value.id in classes


def shared(root):
    """Return {name: files} of the names that several modules define, unless all are aliases of members."""
    places = defaultdict(dict)
    for file in (path for package in ('imu_calibration', 'msg_adapters') for path in sorted((root / package).rglob('*.py'))):
        for name, is_alias in constants(ast.parse(file.read_text())):
            if not (name in PLUG_INS and file.relative_to(root).match(PLUG_INS[name])):
                places[name][str(file.relative_to(root))] = is_alias
    return {name: sorted(files) for name, files in places.items() if len(files) > 1 and not all(files.values())}


def test_no_two_modules_define_a_constant_of_the_same_name():
    assert shared(ROOT) == {}


def test_private_names_count_and_aliases_of_members_do_not(tmp_path):
    for package, text in (('imu_calibration', '_BLOCK, STILL = 1, 2'), ('msg_adapters', '_BLOCK: int = 2')):
        (tmp_path / package).mkdir()
        (tmp_path / package / 'a.py').write_text(text)
    (tmp_path / 'msg_adapters/b.py').write_text('class Phase:\n    pass\nSTILL, MOVING = Phase\nLOST = Phase.LOST')
    (tmp_path / 'msg_adapters/c.py').write_text('MOVING, LOST = Other.MOVING, Phase.LOST')
    assert shared(tmp_path) == {'_BLOCK': ['imu_calibration/a.py', 'msg_adapters/a.py'],
                                'STILL': ['imu_calibration/a.py', 'msg_adapters/b.py']}
