"""Which files the page may read and write: those below the folder of the start, and what the command line allows."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from turbrestore.core.errors import ConfigurationError
from turbrestore.io.images.image_files import IMAGE_SUFFIXES
from turbrestore.io.limits import input_errors
from turbrestore.io.video import VIDEO_SUFFIXES


@dataclass(frozen=True)
class Entry:
    """One line of the list of a folder.

    Attributes
    ----------
    name : str
        What is shown.
    path : Path
    is_folder : bool
    """

    name: str
    path: Path
    is_folder: bool


@dataclass(frozen=True)
class Folders:
    """Folders whose content the page may read and write.

    Parameters
    ----------
    start : Path
        Folder in which the app was started; names without a folder are meant in it.
    allowed : tuple of Path
        More folders.
    files : tuple of Path
        Single files that may be read.
    """

    start: Path
    allowed: tuple[Path, ...] = ()
    files: tuple[Path, ...] = ()

    def locate(self, name: str) -> Path:
        """Return the path of an input.

        Raises
        ------
        ConfigurationError
            The name is empty, or the file, or what it links to, lies outside the folders.
        """
        path = self._real(name)
        if path not in {file.resolve() for file in self.files} and not self._holds(path):
            raise self._outside(name)
        return path

    def output(self, name: str) -> Path:
        """Return the path of an output; errors as of :meth:`locate`."""
        path = self._real(name)
        if not self._holds(path):
            raise self._outside(name)
        # A link is not replaced by what it leads to: check_output decides about it.
        return self.start / Path(name.strip()).expanduser()

    def shown(self, path: Path) -> Path:
        """Return the path as a command in the folder of the start would name it."""
        return path.relative_to(self.start.resolve()) if path.is_relative_to(self.start.resolve()) else path

    def listing(self, folder: Path) -> list[Entry]:
        """List folders and clips in a folder, folders first; hidden ones are left out.

        Raises
        ------
        ConfigurationError, StorageError, InputNotFoundError
            The folder is outside, or cannot be read.
        """
        folder = self.locate(str(folder))
        with input_errors(folder):
            found = [path for path in folder.iterdir() if not path.name.startswith(".")]
        below = [Entry(f"{path.name}/", path, True) for path in found if path.is_dir()]
        clips = [Entry(path.name, path, False) for path in found if path.suffix.lower() in VIDEO_SUFFIXES]
        clips = [entry for entry in clips if entry.path.is_file()]
        above = [Entry("..", folder.parent, True)] if self._holds(folder.parent) else []
        return [*above, *sorted(below, key=_by_name), *sorted(clips, key=_by_name)]

    def holds_images(self, folder: Path) -> bool:
        """Tell whether a folder holds two images or more, which can be the frames of a clip."""
        folder = self.locate(str(folder))
        with input_errors(folder):
            return sum(path.suffix.lower() in IMAGE_SUFFIXES for path in folder.iterdir()) > 1

    def _real(self, name: str) -> Path:
        if not name.strip() or "\0" in name:
            raise ConfigurationError("path: expected the name of a file, found none")
        try:
            return (self.start / Path(name.strip()).expanduser()).resolve()
        except (OSError, RuntimeError) as error:
            raise ConfigurationError(f"{name}: cannot be found ({error})") from error

    def _holds(self, path: Path) -> bool:
        return any(path.is_relative_to(folder.resolve()) for folder in (self.start, *self.allowed))

    def _outside(self, name: str) -> ConfigurationError:
        return ConfigurationError(
            f"{name}: lies outside the folder that the app was started in; start the app there, or with --allow DIR"
        )


def printable(text: object) -> str:
    """Return text that a browser can be sent: on most systems file names are bytes, which need not be valid text."""
    return str(text).encode(errors="replace").decode()


def _by_name(entry: Entry) -> str:
    return entry.name.lower()
