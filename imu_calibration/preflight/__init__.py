"""
Checks of a recording before the estimate.

In: cleaned blocks of samples as they pass. Out: findings with a severity.
Read `checks` first: the registry of checks.
"""
