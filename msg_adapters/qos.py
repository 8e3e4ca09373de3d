"""Quality-of-service profiles of recorded topics, from any version of the metadata to version 9, which spells them out."""

from collections.abc import Sequence

from imu_calibration.documents import parsed
from imu_calibration.errors import InputError

_NAMES = {
    'history': ('system_default', 'keep_last', 'keep_all', 'unknown'),
    'reliability': ('system_default', 'reliable', 'best_effort', 'unknown', 'best_available'),
    'durability': ('system_default', 'transient_local', 'volatile', 'unknown', 'best_available'),
    'liveliness': ('system_default', 'automatic', 'manual_by_node', 'manual_by_topic', 'unknown', 'best_available'),
}


def spelled_out(profiles: Sequence) -> list:
    """Return offered_qos_profiles as a list of mappings with names in place of numbers; empty when they make no sense."""
    if isinstance(profiles, str):
        try:
            profiles = parsed(profiles, 'QoS profile')
        except InputError:
            profiles = []
    if not isinstance(profiles, list) or not all(isinstance(profile, dict) for profile in profiles):
        return []
    return [{key: _name(key, value) for key, value in profile.items()} for profile in profiles]


def _name(key, value):
    names = _NAMES.get(key)
    if names is None or not isinstance(value, int):
        return value
    return names[value] if 0 <= value < len(names) else 'unknown'
