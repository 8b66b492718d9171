"""Progress on stderr: only on a terminal, and only for what takes longer than two seconds."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator
from typing import Any, TypeVar

from pipefish.terminal import printable, say

SHOW_AFTER_S = 2.0
NOTE_WIDTH = 90  # of a line without its bar: figures, and a note of a live measurement
T = TypeVar("T")


class Progress:
    """A progress bar that appears after two seconds and only on a terminal.

    with Progress("drawing", total=20) as bar: ... bar.update(completed, "note")
    """

    def __init__(self, what: str, total: float | None = None, quiet: bool = False) -> None:
        self._what, self._total = what, total
        self._start = time.monotonic()
        self._quiet = quiet
        self._enabled = not quiet and sys.stderr.isatty()
        self._bar: Any = None
        self._task: Any = None

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def update(self, completed: float, note: str = "", total: float | None = None) -> None:
        """Sets how much is done; `note` stands behind the bar."""
        self._total = total if total is not None else self._total
        if not self._enabled or (self._bar is None and time.monotonic() - self._start < SHOW_AFTER_S):
            return
        if self._bar is None:
            self._open()
        self._bar.update(self._task, completed=completed, total=self._total, note=printable(note, sys.stderr.encoding))

    @property
    def shows(self) -> bool:
        """Whether there is a terminal to show a bar on."""
        return self._enabled

    def say(self, text: str) -> None:
        """A line that stays, above the bar where there is one; nothing where all is to be quiet."""
        if self._bar is not None:
            self._bar.console.print(printable(text, sys.stderr.encoding), markup=False, highlight=False)
        else:
            say(text, self._quiet)

    def _open(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
        from rich.progress import Progress as RichProgress
        from rich.table import Column

        console = Console(stderr=True)
        # Where a terminal is narrow the bar is short and the note wraps: the figures stay whole.
        self._bar = RichProgress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=min(40, max(10, console.width - NOTE_WIDTH)), table_column=Column(no_wrap=True)),
            MofNCompleteColumn(table_column=Column(no_wrap=True)),
            TimeElapsedColumn(table_column=Column(no_wrap=True)),
            TextColumn("{task.fields[note]}", markup=False, table_column=Column()),
            console=console,
            transient=True,
        )
        self._task = self._bar.add_task(self._what, total=self._total, note="")
        self._bar.start()


def track(items: Iterable[T], what: str, total: int | None = None, quiet: bool = False) -> Iterator[T]:
    """Yields `items` under a progress bar."""
    with Progress(what, total, quiet) as bar:
        for done, item in enumerate(items):
            bar.update(done)
            yield item
