"""What somebody may have meant by a word that names no file or no option."""

from __future__ import annotations

import difflib
import glob
import re
from collections.abc import Sequence
from pathlib import Path

from cyclopts import UnknownOptionError

# Share of letters that an option has in common with the one that is suggested; --verbose and --derotate have 0.53.
_ALIKE = 0.7
_MISSING = "no such file or folder"
_NO_STREAM = "expected the name of a file; steady alone reads and writes standard streams"


def unknown_option(error: UnknownOptionError) -> str:
    """Say what is wrong with a word that begins with a hyphen: it may be a file, or an option spelled wrongly."""
    word = error.token.keyword or error.token.value
    if error.token.source == "cli" and (re.fullmatch(r"-[^-].*\.\w+", word) or Path(word).exists()):
        return f"{word}: taken for an option; write ./{word}, or -- before the paths"
    text, _, suggestion = str(error).partition(" Did you mean ")
    typed, known = word.lstrip("-"), suggestion.strip(" -?")
    alike = difflib.SequenceMatcher(None, typed, known).ratio()
    # Few people mistype the first letter, and --rotate asks for something else than --derotate does.
    return str(error) if alike >= _ALIKE and typed[:1] == known[:1] else text


def with_meaning(message: str, words: Sequence[str]) -> str:
    """Show the path of a message as it was typed, and say what to do about an address, a pattern or a hyphen."""
    for word in words:
        name = str(Path(word))
        if not message.startswith(f"{name}: ") or word.startswith("--"):
            continue
        rest = message.removeprefix(f"{name}: ")
        if word == "-":
            return message if words[0] == "steady" else f"{word}: {_NO_STREAM}"
        return f"{word}: {rest}{_remedy(word) if rest == _MISSING else ''}"
    return message


def _remedy(word: str) -> str:
    if "://" in word:
        return "; addresses are not opened, so download the video first"
    if re.search(r"%\d*d", word):
        return "; a series of images is read by the name of its folder"
    if glob.has_magic(word):
        return "; batch takes patterns, other commands one file or folder"
    return ""
