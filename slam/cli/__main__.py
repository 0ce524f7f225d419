"""`python -m slam.cli`: the same as the command `spplanes`."""

from slam.cli import main

if __name__ == "__main__":  # worker processes import it under another name
    main()
