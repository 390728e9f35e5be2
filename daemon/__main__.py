"""`python -m daemon` is the command `surfclass`, of this interpreter."""

from daemon.cli import main

main()
