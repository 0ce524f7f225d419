"""`python -m slam.cli`: the same as the command `spplanes`."""

from slam.cli import main

main()
