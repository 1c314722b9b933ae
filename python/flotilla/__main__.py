"""The command-line program `flotilla`, also available as `python -m flotilla`."""

from __future__ import annotations

import os
import signal
import sys
import sysconfig

from flotilla import _native


def main() -> None:
    """Runs the command line, and exits with the program's exit code."""
    # The program handles signals itself, and saves before it stops.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    if sys.platform.startswith("linux") and not os.path.isabs(os.environ.get("XDG_RUNTIME_DIR", "")):
        # Vulkan layers look for a display in this directory, and print warnings if it is not set.
        os.environ["XDG_RUNTIME_DIR"] = "/dev/null"
    command = os.path.join(sysconfig.get_path("scripts"), "flotilla" + (sysconfig.get_config_var("EXE") or ""))
    program = command if os.path.exists(command) else "flotilla"
    sys.exit(_native.main([program, *sys.argv[1:]]))


if __name__ == "__main__":
    main()
