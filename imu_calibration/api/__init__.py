"""
Tasks of the user, from files to files.

The command line, notebooks and scripts call the same functions.

In: paths of recordings and tables, choices by name. Out: results that print, draw and save
themselves. Read `calibrate` first.
"""
