"""The F test of squares that fall: asked of windows on a table and of poses and turns by hand."""

from scipy.special import fdtrc


def chance_of_fall(fall: float, added: int, *, rest: float, spare: float) -> float:
    """
    Return the chance that noise alone lets squares fall by so much.

    Parameters
    ----------
    fall : float
        By which the squares fall, below zero as zero.
    added : int
        Parameters that were added.
    rest : float
        Squares that are left.
    spare : float
        Their degrees of freedom.

    """
    return float(fdtrc(added, spare, max(fall, 0.0) / added / max(rest / spare, 1e-12)))
