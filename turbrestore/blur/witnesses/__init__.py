"""What frames and image say about a blur: theory, measurements, and the likelihood of every hypothesis."""
