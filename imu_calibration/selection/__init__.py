"""
Selection of the effects that the data of any reference support.

In: an `Evidence` and `Question` objects. Out: the effects named, with their scores. Read `search`
first, then `order_of_tests`. What differs between few rows and windows is in
`references.rows` and `references.turntable.selection`.
"""
