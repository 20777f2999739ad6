"""`python -m daemon.cli`: the same as `toolpoint`."""

from daemon.cli import main

main()
