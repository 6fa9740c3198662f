"""How ``--help`` looks: one line for each option that people use; ``--help-all`` explains every option."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any

from cyclopts.help import PlainFormatter

if TYPE_CHECKING:
    from cyclopts.help import HelpEntry, HelpPanel
    from rich.console import Console, ConsoleOptions

EVERYTHING = "--help-all"
# Options without a dot that few people need; those with a dot are settings of a stage.
RARE = {
    *("--strict", "--skip-damaged", "--max-pixels", "--checkpoint-every", "--uncertainty", "--truth", "--until"),
    *(
        "--tile",
        "--scheduler",
        "--workers",
        "--threads",
        "--static-mask",
        "--reference",
        "--derotate",
        "--axes",
    ),
    *("--inner-scale", "--outer-scale", "--layers", "--pupil-samples", "--field-spacing", "--sub-frames"),
    *("--channel-wavelengths", "--nyquist"),
}
# Options that few people need of a command with presets, and that are the point of others.
RARE_IN_RESTORE = {"--pixel-scale", "--aperture", "--distance", "--wavelength", "--psf", "--like"}
# Columns for the names of options, and for the text if the terminal does not say.
_NAMES, _WIDEST = 30, 110
_ENDS = (". ", "; ", ": ", ", ", " (")


class Formatter(PlainFormatter):
    """Two columns without frames; ``full`` lists every option with all of its text, settings stage by stage."""

    def __init__(self, full: bool) -> None:
        super().__init__()
        self.full = full

    def __call__(self, console: Console, options: ConsoleOptions, panel: HelpPanel) -> None:
        """Print one list of commands, arguments or options."""
        if not panel.entries:
            return
        width = min(options.max_width, _WIDEST)
        entries = [(entry, _text(console, options, entry.description)) for entry in panel.entries]
        names = {name for entry in panel.entries for name in entry.positive_names}
        rare = RARE | RARE_IN_RESTORE if "--preset" in names else RARE
        everything = self.full or panel.format == "command"
        shown = entries if everything else [one for one in entries if _usual(one[0], rare)]
        title = "Options" if panel.title == "Parameters" else panel.title
        lines: list[str] = []
        for section, group in _by_stage(shown):
            lines += ["", f"{title}:" if not section else f"{section}:"] if lines or not section else [f"{section}:"]
            for entry, text in group:
                # The summary of a command is written to fit.
                lines += _rows(entry, text, width, everything)
        if len(shown) < len(entries):
            lines += [
                "",
                f"{EVERYTHING} explains these and {len(entries) - len(shown)} more: the settings of each stage.",
            ]
        # A list as a whole, because a terminal must not break or colour it.
        console.print("\n".join(lines), highlight=False, markup=False, soft_wrap=True)


def _usual(entry: HelpEntry, rare: set[str]) -> bool:
    return not any("." in name or name in rare for name in entry.positive_names)


def _by_stage(entries: Iterable[tuple[HelpEntry, str]]) -> Iterator[tuple[str, list[tuple[HelpEntry, str]]]]:
    """Entries without a dot, then those of each stage by the words before the last dot."""
    stages: dict[str, list[tuple[HelpEntry, str]]] = {"": []}
    for entry, text in entries:
        name = next(iter(entry.positive_names), "").removeprefix("--")
        stages.setdefault(name.rpartition(".")[0], []).append((entry, text))
    return ((stage, group) for stage, group in stages.items() if group)


def _rows(entry: HelpEntry, text: str, width: int, whole: bool) -> list[str]:
    """Lines of one entry: as many as its text takes, or one."""
    names = ", ".join([*entry.positive_names, *entry.positive_shorts, *entry.negative_names]) or entry.positional_label
    value = "|".join(entry.choices or ()) or entry.metavar or ""
    if len(value) > _NAMES:
        # Many choices would leave no room for the text.
        text, value = f"{text} One of {', '.join(entry.choices or ())}.", "CHOICE"
    head = f"  {names} {'' if entry.positional_label else value}".rstrip()
    default = "" if entry.default in (None, "False", "None", "") else f"[{entry.default}]"
    room = width - _NAMES - 2
    if whole:
        body = textwrap.wrap(f"{text} {default}".strip(), room, break_on_hyphens=False) or [""]
    else:
        body = [f"{_cut(text, room - len(default) - bool(default))} {default}".strip()]
    if len(head) > _NAMES:
        return [head, *(f"{'':<{_NAMES + 2}}{line}" for line in body)]
    return [f"{head:<{_NAMES + 2}}{body[0]}".rstrip(), *(f"{'':<{_NAMES + 2}}{line}" for line in body[1:])]


def _cut(text: str, room: int) -> str:
    """Longest beginning of a text that ends with a clause and fits; its first words where no clause is so short."""
    text = text.removesuffix(".")
    if len(text) <= room:
        return text
    ends = [
        at
        for end in _ENDS
        for at in range(room + 1)
        if text.startswith(end, at) and text[:at].count("(") == text[:at].count(")")
    ]
    sentence = next((at for at in ends if text.startswith(". ", at)), None)
    if sentence is not None:
        return text[:sentence]
    return text[: max(ends)] if ends else textwrap.shorten(text, room, placeholder="…")


def _text(console: Console, options: ConsoleOptions, description: Any) -> str:
    """Words of a description without its markup."""
    if description is None:
        return ""
    parts = console.render(description, options.update(width=10_000))
    plain = re.sub(r":\w+:`~?([^`]*)`|``([^`]*)``", r"\1\2", "".join(part.text for part in parts))
    return " ".join(plain.split())
