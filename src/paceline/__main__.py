"""Runs the command line program: ``python -m paceline``."""

from paceline.cli import main

main()
