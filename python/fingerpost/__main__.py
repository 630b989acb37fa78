"""`python -m fingerpost` is `fingerpost`."""

from fingerpost.cli import main

main()
