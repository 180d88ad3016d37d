"""`python -m calibray` runs `calibray` where the command is not on the path."""

from calibray.cli import main

main()
