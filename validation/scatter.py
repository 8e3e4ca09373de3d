"""
Standard deviations against the scatter over many simulated sessions, on a table and by hand.

White noise and wandering biases; an IMU, a tilt and an arm of each seed.
"""

from validation.section import Section, text

SESSIONS = 120
BY_HAND = 100
"""Sessions by hand, of each kind of sensor."""


def run(folder, plots):
    """Return the section."""
    from worlds.hand_scatter import hand_scatter
    from worlds.scatter import scatter, windows_of_a_short_session

    section = Section('Reported standard deviations and the scatter over sessions')
    found = scatter(windows_of_a_short_session(), range(SESSIONS))
    claim_errors(
        section,
        f'{SESSIONS} simulated sessions on a table: mean square of errors over reported sd',
        found,
        mean_square=(0.95, 1.05),
        coverage=(0.935, 0.965),
    )
    section.claim(
        'sd of the errors of each parameter over its median reported sd',
        '0.77 to 1.20',
        f'{found.least_ratio:.2f} to {found.largest_ratio:.2f}',
        found.least_ratio >= 1 / 1.3 and found.largest_ratio <= 1.20,
    )
    section.claim(
        'reported sd above 1.5 times the median one of the parameter',
        'below 5 %',
        f'{found.widest_share:.1%}',
        found.widest_share < 0.05,
    )
    section.claim(
        'rms error over the Cramer-Rao bound of an estimator that knows the noise',
        'at most 1.05',
        f'{found.over_bound:.3f}',
        found.over_bound <= 1.05,
    )
    for response, sensitivity in (
        ('without a response to gravity', 0.0),
        ('whose gyroscope responds to gravity', 5e-4),
    ):
        by_hand = hand_scatter(range(BY_HAND), sensitivity)
        claim_errors(
            section,
            f'{BY_HAND} simulated sessions by hand {response}: normalised squared error',
            by_hand,
            mean_square=(0.85, 1.20),
            coverage=(0.93, 0.97),
        )
    section.say(text('scatter'))
    return section


def claim_errors(section, claim, found, *, mean_square, coverage):
    """
    Claim the errors of some sessions in reported standard deviations.

    `found` has a mean square and a coverage, and the limits of each are (lowest, highest).
    """
    low, high = mean_square
    section.claim(
        claim,
        f'{low:.2f} to {high:.2f}',
        f'{found.mean_square:.3f}',
        low <= found.mean_square <= high,
    )
    low, high = coverage
    section.claim(
        'share of errors within the 95 % interval',
        f'{low} to {high}',
        f'{found.coverage:.4f}',
        low <= found.coverage <= high,
    )
