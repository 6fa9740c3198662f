"""What a process has used of the machine; imports nothing, since environments of other packages run it too."""

import time
from pathlib import Path

# The high-water mark in getrusage survives the exec of a child and would count the memory of its parent.
STATUS = Path("/proc/self/status")


def processor_seconds() -> float:
    """Processor time of all threads of this process, s."""
    return time.process_time()


def peak_megabytes() -> float:
    """Largest resident memory of this process since it began, MB; NaN where the system does not tell (Linux does)."""
    if not STATUS.exists():
        return float("nan")
    lines = dict(line.split(":", 1) for line in STATUS.read_text().splitlines() if ":" in line)
    return int(lines["VmHWM"].split()[0]) * 1024 / 1e6
