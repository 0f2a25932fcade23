"""What tests of readers measure."""

import tracemalloc

from frontend.readers import Log


def peak_memory(log: Log) -> int:
    """Bytes allocated at most while the scans of ``log`` are taken one by one."""
    tracemalloc.start()
    for _ in log.scans():
        pass
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return most
