"""Texts of pages on the data of a reference."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ObservationTexts:
    """Texts on windows, or on poses and turns."""

    span: str
    """Over what a residual is a mean."""
    drawing: str
    """How residuals are drawn."""
    amount: str
    """Heading of the amount of data behind an error."""
    in_turn: str
    """How data were held out for the gain."""
    selection: str
    """How effects were selected."""


OBSERVATION_TEXTS = {
    'windows': ObservationTexts(
        'over 0.25 s',
        'averaged over 0.25 s',
        'duration',
        '',
        'Selected on held-out windows; the gain is measured on other windows, which the selection'
        ' did not use.',
    ),
    'poses': ObservationTexts(
        'of each pose',
        'one point for each pose',
        'poses or turns',
        ' in turn',
        'Selected on poses that were held out in turn; for the gain the complete search is repeated'
        ' without some of the poses and tested on them.',
    ),
}
"""Unit of the data (`Observations.unit`) -> texts."""
