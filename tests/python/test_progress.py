"""The progress bar on a terminal."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import struct
import sys
import termios

import pytest

NOTE = "4.46 m: diameter 299.6 ± 3.6 mm at 3.77 m, oval 4.2 %"


@pytest.mark.parametrize("columns", [60, 80, 130])
def test_the_bar_shows_its_figures_and_all_of_its_note_on_a_narrow_terminal_too(columns):
    code = (
        "from pipefish import progress\n"
        "progress.SHOW_AFTER_S = 0\n"
        f"with progress.Progress('receiving', 152) as bar: bar.update(117, {NOTE!r}); bar._bar.refresh()"
    )
    child, terminal = pty.fork()
    if child == 0:
        fcntl.ioctl(2, termios.TIOCSWINSZ, struct.pack("4H", 24, columns, 0, 0))
        environment = {k: v for k, v in os.environ.items() if k not in ("COLUMNS", "LINES", "NO_COLOR", "CI")}
        os.execve(sys.executable, [sys.executable, "-c", code], environment | {"TERM": "xterm", "PYTHONUTF8": "1"})
    written = b""
    try:
        while part := os.read(terminal, 65536):
            written += part
    except OSError:  # Linux's word for the end of a terminal
        pass
    finally:
        os.close(terminal)
    assert os.waitpid(child, 0)[1] == 0, written
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", written.decode())
    assert "117/152" in text and "0:00:00" in text and "…" not in text
    drawn = text[text.rindex("117/152") :].split()
    assert [w for w in drawn if w in NOTE.split()] == NOTE.split()
    assert max(map(len, re.split(r"[\r\n]+", text))) <= columns
