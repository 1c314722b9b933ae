"""The program: what `flotilla` does in a shell, by `python -m flotilla` or the command that comes with the package."""

from __future__ import annotations

import os
import signal
import sys
import sysconfig

from flotilla import _native


def main() -> None:
    """Does what was typed, and ends with the program's exit code."""
    # The program listens for signals itself, and saves before it stops.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    if sys.platform.startswith("linux") and not os.path.isabs(os.environ.get("XDG_RUNTIME_DIR", "")):
        # Vulkan's layers look for a display there, and complain where they cannot.
        os.environ["XDG_RUNTIME_DIR"] = "/dev/null"
    command = os.path.join(sysconfig.get_path("scripts"), "flotilla" + (sysconfig.get_config_var("EXE") or ""))
    program = command if os.path.exists(command) else "flotilla"
    sys.exit(_native.main([program, *sys.argv[1:]]))


if __name__ == "__main__":
    main()
