"""``python -m mrtm``."""

from mrtm.cli import main

main()
