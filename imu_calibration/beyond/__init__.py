"""
What the findings of a search leave: how much, where it sits, how it goes, and the formula that a user may take into the model.

In: an investigation. Out: for each sensor what stays unexplained, with regimes and a proposal where it is significant; and the
investigation without findings that a formula does without. Read `unexplained`, then `proposals`.
"""
