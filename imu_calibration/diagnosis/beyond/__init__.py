"""
What no effect of the catalogue explains: where it sits, how it goes, and the formula that a user may take into the model.

In: an investigation whose rest is significant. Out: regimes and proposals for each sensor. Read `proposals` first.
"""
