"""
Selection of the effects that the data of any reference support.

In: an `Evidence` and `Question` objects. Out: the effects named, with their scores. Read `search`
first, then `order_of_tests`. The evidence and its data are those of the references:
`references.turntable.selection` and `references.rows`.
"""
