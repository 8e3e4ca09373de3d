"""The F test of a fall of the sum of squares: for windows on a table and for poses and turns by hand."""

from scipy.special import fdtrc


def chance_of_fall(fall: float, added: int, *, rest: float, spare: float) -> float:
    """
    Return the p-value of the fall of a sum of squares.

    Parameters
    ----------
    fall : float
        Fall of the sum of squares; a negative value counts as zero.
    added : int
        Parameters that were added.
    rest : float
        Residual sum of squares.
    spare : float
        Its degrees of freedom.

    """
    return float(fdtrc(added, spare, max(fall, 0.0) / added / max(rest / spare, 1e-12)))
