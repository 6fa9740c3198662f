"""How a computation uses the machine: threads, memory, devices, scratch files, compiled loops and tiles."""
