"""
What looks wrong with a recording before anything is estimated from it.

In: cleaned blocks of samples as they pass. Out: findings with a severity.
Read `checks` first: the registry of checks.
"""
