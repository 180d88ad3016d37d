"""Makes `python -m calibray` equivalent to the command `calibray`, for when the command is not on the path."""

from calibray.cli import main

main()
