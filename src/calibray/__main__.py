"""Allow `python -m calibray` to be used if the command `calibray` is not on the search path."""

from calibray.cli import main

main()
