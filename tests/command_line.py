"""What the tests of the command line share."""

from turbrestore.io.video import write_video

# One pass each, for tests that look at files and words and not at the image.
QUICK = ["--centroid.iterations", "1", "--filter.inner-iterations", "1", "--quiet"]
# And a known blur, all but left as it is, where the blur does not matter either.
QUICKEST = ["--sigma", "1", "--deconvolution.iterations", "3", *QUICK]


def fails(result, code, *parts):
    """One line on standard error that names the parts, nothing on standard output."""
    found, out, err = result
    assert found == code, err
    assert out == ""
    assert err.startswith("turbrestore: ")
    assert err.count("\n") == 1
    for part in parts:
        assert part in err


def frames_clip(path, frames):
    write_video(path, frames, 25)
    return path
