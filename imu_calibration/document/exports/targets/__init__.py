"""
One module for each program or family of programs.

`export.all_targets` imports every module of this folder.
"""
