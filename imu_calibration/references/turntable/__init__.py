"""
Reference by a turntable or an arm.

Gathered windows, held-out windows, the model extended by selected effects.
"""
