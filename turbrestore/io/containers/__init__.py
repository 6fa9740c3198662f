"""Containers of video: what is decoded from them, what is damaged in them, and how they are written."""
