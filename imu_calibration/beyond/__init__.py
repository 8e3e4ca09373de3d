"""
Analysis of the residual of a search: its size, location and frequencies, and a formula that a user may add to the model.

In: an investigation. Out: for each sensor the unexplained excess, with regimes and a proposal where it is significant; and the
investigation without findings that a formula replaces. Read `unexplained`, then `proposals`.
"""
