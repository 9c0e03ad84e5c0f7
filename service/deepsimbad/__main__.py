"""`python -m deepsimbad` is the `deepsimbad` command."""

from deepsimbad.cli import main

main()
