"""Reference by a turntable or an arm: gathered windows, held-out windows, the model extended by selected effects."""
