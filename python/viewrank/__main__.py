"""The program ``viewrank``, as ``pip`` installs it; also ``python -m viewrank``."""

import signal
import sys

from . import _viewrank


def main() -> None:
    """Run the program with the arguments of this process and exit with its code."""
    # Ctrl-C ends the program itself, as it does elsewhere; Python would wait for it to return.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    sys.exit(_viewrank.main(["viewrank", *sys.argv[1:]]))


if __name__ == "__main__":
    main()
