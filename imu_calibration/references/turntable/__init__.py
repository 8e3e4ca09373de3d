"""
Reference by a turntable or an arm.

Windows reduced to statistics (`window_statistics`) and accumulated as rows (`accumulator`),
gathered windows, held-out windows, the model extended by selected effects.
"""
