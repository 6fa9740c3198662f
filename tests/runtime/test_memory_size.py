"""Sizes of memory as people write them."""

import pytest

from turbrestore.core.errors import ConfigurationError
from turbrestore.runtime.memory_size import MemorySize
from turbrestore.runtime.runtime import Runtime


@pytest.mark.parametrize(
    ("text", "size"),
    [("2GB", 2e9), ("1.5 GiB", 1.5 * 2**30), ("800mb", 8e8), ("64 KiB", 65536), ("3000000", 3e6), (7e8, 7e8)],
)
def test_sizes_are_read(text, size):
    assert MemorySize(text) == size
    assert Runtime(memory_limit=text).memory_limit == size


@pytest.mark.parametrize("text", ["", "GB", "2 bananas", "2QB", "0", "-1GB", "nan", "inf", "1e400GB", "2 G B", True])
def test_what_is_no_size_is_refused(text):
    with pytest.raises(ConfigurationError, match="^memory_limit: expected a size such as 2GB") as caught:
        MemorySize(text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "meant"), [("2GBB", "2GB"), ("2G", "2GB"), ("3", "3GB"), ("512 k", "512kB"), ("1.5mi", "1.5MiB")]
)
def test_a_unit_that_is_nearly_right_is_suggested(text, meant):
    with pytest.raises(ConfigurationError, match=rf"did you mean {meant}\?"):
        MemorySize(text)


@pytest.mark.parametrize("text", ["2QB", "2 bananas", "plenty"])
def test_nothing_is_suggested_for_a_guess(text):
    with pytest.raises(ConfigurationError) as caught:
        MemorySize(text)
    assert "did you mean" not in str(caught.value)
