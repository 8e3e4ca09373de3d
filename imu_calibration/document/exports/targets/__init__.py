"""One module for each program or family of programs; `registry` finds them by itself."""
