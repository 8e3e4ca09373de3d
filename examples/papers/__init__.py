"""
The equations of Avrutov 2017 and Zhang 2017 as printed, with errata.

In: the designs and numbers of the papers. Out: their results, for examples and tests.
Read `avrutov2017` and `zhang2017` first.
"""
