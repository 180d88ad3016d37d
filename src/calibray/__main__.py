"""Run the command line with `python -m calibray`, even if the command `calibray` is not on the search path."""

from calibray.cli import main

main()
