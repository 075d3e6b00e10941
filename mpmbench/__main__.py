"""``python -m mpmbench`` is the command line."""

from mpmbench.cli import main

main()
