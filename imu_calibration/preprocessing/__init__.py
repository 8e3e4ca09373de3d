"""
A stream becomes checked windows.

In: blocks of samples and a table. Out: clean samples, static windows, constant-rate spins, dynamic
stretches, findings with a severity. Read `window_finder` first; static poses are found in
`rest_detection`; `checks` is the registry of checks.
"""
