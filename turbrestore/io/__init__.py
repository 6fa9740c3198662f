"""Images and videos in and out, one module a format."""
