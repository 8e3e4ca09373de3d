"""Candidates of the search for effects where the search is not the subject."""

from dataclasses import replace

FEW = (
    'accel_quadratic+accel_cubic+accel_bias_drift+gyro_g_sensitivity+gyro_bandwidth'
    '+gyro_bias_drift+time_offset'
)
"""Argument `candidates` of `calibrate` and `diagnose`: a third of the time."""


def with_candidates(model, candidates=FEW):
    """Return the model whose search tests only these effects of the catalogue."""
    return replace(model, catalogue=model.catalogue.with_candidates(candidates))


def searching_few(arguments, candidates=FEW):
    """Return the arguments of a verb, with these candidates where it searches."""
    if arguments[0] in ('calibrate', 'diagnose') and '--model-as-asked' not in arguments:
        return [*arguments, '--candidates', candidates]
    return list(arguments)
