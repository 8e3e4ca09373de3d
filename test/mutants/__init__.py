"""Single faults put into the code, one at a time, and which tests must notice: `make mutants`."""
