"""Runs a command and prints, as the last line, its exit code, wall clock and use of the machine, as JSON.

A process begins its life as a copy of the one that starts it, and the system remembers the memory of that copy as its
peak. So the benchmark, which is big, starts this, which is small: ``python -I -S launcher.py OUTPUT COMMAND...``.
"""

import json
import os
import sys
import time


def main(output: str, *command: str) -> None:
    """Run ``command``, what it prints going to the file ``output``."""
    log = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    nothing = os.open(os.devnull, os.O_RDONLY)
    files = [(os.POSIX_SPAWN_DUP2, nothing, 0), (os.POSIX_SPAWN_DUP2, log, 1), (os.POSIX_SPAWN_DUP2, log, 2)]
    started = time.perf_counter()
    pid = os.posix_spawnp(command[0], command, os.environ, file_actions=files)
    _, status, usage = os.wait4(pid, 0)
    wall = time.perf_counter() - started
    cpu = usage.ru_utime + usage.ru_stime
    print(json.dumps([os.waitstatus_to_exitcode(status), wall, cpu, usage.ru_maxrss]))


if __name__ == "__main__":
    main(*sys.argv[1:])
