"""
Vocabulary of all packages.

In: arrays, mappings and texts. Out: samples, settings, units, errors, YAML documents,
probabilities. Read `samples` and `errors` first.
"""
