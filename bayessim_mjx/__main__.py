"""`python -m bayessim_mjx COMMAND`: the same as `bayessim-mjx COMMAND`."""

import sys

from bayessim_mjx.main import main

if __name__ == "__main__":
    sys.exit(main())
