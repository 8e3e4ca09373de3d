"""
The SROS 2 policy.

The structure of the sros2 schema (policy version 0.2.0), and every name that a node uses.
"""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

POLICY = Path(__file__).resolve().parents[2] / 'config' / 'sros2_policy.xml'
LISTS = {
    'topics': ('topic', {'publish', 'subscribe'}),
    'services': ('service', {'reply', 'request'}),
    'actions': ('action', {'call', 'execute'}),
}
"""List of a profile -> element, attributes with ALLOW or DENY."""
LISTS_OF = {
    'publisher': ('topics', 'publish'),
    'subscriber': ('topics', 'subscribe'),
    'service': ('services', 'reply'),
}
"""Kind of a name in the graph -> list, attribute."""
NODES = {
    'calibration_node',
    'compensator_node',
    'planner_node',
    'simulator_node',
    'bag_player_node',
}


def children(element, name):
    """The children, all of which must have this name."""
    assert len(element) and {child.tag for child in element} == {name}
    return list(element)


def profiles():
    """Node -> {(list, attribute): names}, after a check of the structure."""
    root = ElementTree.parse(POLICY).getroot()
    assert root.tag == 'policy' and root.attrib == {'version': '0.2.0'}
    found = {}
    (enclaves,) = children(root, 'enclaves')
    for enclave in children(enclaves, 'enclave'):
        assert set(enclave.attrib) == {'path'} and enclave.attrib['path'].startswith('/')
        for profile in children(children(enclave, 'profiles')[0], 'profile'):
            assert set(profile.attrib) == {'ns', 'node'} and profile.attrib['ns'].startswith('/')
            allowed = found[profile.attrib['node']] = {}
            for part in profile:
                item, attributes = LISTS[part.tag]
                assert (
                    part.attrib
                    and set(part.attrib) <= attributes
                    and set(part.attrib.values()) <= {'ALLOW', 'DENY'}
                )
                for attribute, rule in part.attrib.items():
                    names = [child.text for child in children(part, item)]
                    assert rule == 'ALLOW' and len(set(names)) == len(names) and all(names)
                    allowed[part.tag, attribute] = names
    return found


def test_the_structure_is_that_of_the_schema_and_only_calibration_node_publishes_calibrations():
    found = profiles()
    assert found.keys() == NODES
    assert [
        node for node, allowed in found.items() if 'imu/calibration' in allowed['topics', 'publish']
    ] == ['calibration_node']


@pytest.mark.live
@pytest.mark.usefixtures('executor_only')
def test_every_name_of_compensator_node_is_in_the_policy(bench):
    from imu_calibration.nodes.compensator_node import CompensatorNode

    node = bench.start(CompensatorNode, {})
    own = {
        (LISTS_OF[kind], name)
        for kind in LISTS_OF
        for name, _ in getattr(node, f'get_{kind}_names_and_types_by_node')('compensator_node', '/')
    }
    allowed = {
        (key, absolute(name))
        for key, names in profiles()['compensator_node'].items()
        for name in names
    }
    missing = {
        entry for entry in own if entry not in allowed and 'type_description' not in entry[1]
    }
    assert len(own) > 8 and not missing


def absolute(name):
    """The name of compensator_node in the root namespace."""
    return (
        name.replace('~', '/compensator_node')
        if name.startswith('~')
        else name
        if name.startswith('/')
        else f'/{name}'
    )
