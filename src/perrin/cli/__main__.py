"""`python -m perrin.cli`: the command line without its installed command."""

from perrin.cli.app import main

main()
