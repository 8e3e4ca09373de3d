"""Exit codes of results, and the share of dropped samples from which a result is incomplete."""

from collections.abc import Mapping, Sequence

DROPPED_SHARE = 0.01
"""Share of the samples up to which dropped samples are a note; above it the exit code is 3."""
UNKNOWN_EXTENT = 'of unknown extent'
"""Part of the reason of a loss whose count is a lower bound, such as a damaged file."""
COMPLETE, INCOMPLETE = 0, 3
"""Exit codes of a result: complete, or written with reasons why it is not."""


def dropped_text(dropped: Mapping[str, int], kept: int) -> str:
    """
    Return why dropped samples make a result incomplete; '' up to DROPPED_SHARE of the samples.

    A loss of unknown extent is always a reason, because its share is not known.

    Parameters
    ----------
    dropped : mapping
        Reason -> samples that were not used because of a fault.
    kept : int
        Samples without a fault.

    """
    count = sum(dropped.values())
    share = count / max(count + kept, 1)
    unknown = [reason for reason, number in dropped.items() if number and UNKNOWN_EXTENT in reason]
    if unknown:
        return f'an unknown share of the samples is dropped: {", ".join(unknown)}'
    if share <= DROPPED_SHARE:
        return ''
    reasons = ', '.join(f'{number} {reason}' for reason, number in dropped.items() if number)
    return (
        f'{100 * share:.2g} % of the samples are dropped, more than {100 * DROPPED_SHARE:g} %:'
        f' {reasons}'
    )


def exit_code_of(reasons: Sequence[str]) -> int:
    """Return 3 when there are reasons why a result is incomplete, otherwise 0."""
    return INCOMPLETE if reasons else COMPLETE
