"""Where `uncertain-lti` starts: an installation that cannot be imported never ends with the exit status of an alarm."""

from __future__ import annotations

import sys
import traceback

from uncertain_lti.cli.command import FAULT, INTERRUPTED


def main() -> int:
    """Import the program and run it.

    Returns
    -------
    int
        Exit status, as of `uncertain_lti.cli.main.main`; 70 as well if something of the program cannot be imported.
    """
    try:
        from uncertain_lti.cli.main import main as run
    except KeyboardInterrupt:
        return INTERRUPTED
    except Exception:
        traceback.print_exc()
        print("uncertain-lti: the installation is damaged; install uncertain-lti-ros again", file=sys.stderr)
        return FAULT
    return run()
