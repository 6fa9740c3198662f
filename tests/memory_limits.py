"""What the plan within a memory limit is asked in several tests."""

import pytest

from turbrestore.core.errors import ConfigurationError
from turbrestore.memory_plan import plan_memory
from turbrestore.runtime.memory_size import MemorySize
from turbrestore.runtime.runtime import Runtime
from turbrestore.settings import RestoreParams


def least_limit(shape, threads=2, **params):
    """Return the limit that a refusal names."""
    with pytest.raises(ConfigurationError) as refusal:
        plan_memory(shape, RestoreParams(**params), Runtime(threads=threads, memory_limit=1e8))
    return MemorySize(str(refusal.value).split("at least ")[1].split(" for frames")[0])
