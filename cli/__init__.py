"""Command line of turbrestore: parse, call one function of the library, save."""
