"""What a terminal is told: nothing that commands it, and no letters that it does not have."""

from __future__ import annotations

import sys
import unicodedata


def printable(text: str, encoding: str | None = None) -> str:
    """As a terminal of this encoding [UTF-8] may have it: a survey's or a device's texts could hold codes that clear it
    or fake other lines. What it has no letter for is told otherwise: a long measurement must not end in an error."""
    known = encoding or "utf-8"
    text = "".join(c if c in "\n\t" or unicodedata.category(c)[0] != "C" else f"\\u{ord(c):04x}" for c in text)
    try:
        text.encode(known)
    except UnicodeEncodeError:
        text = text.replace("±", "+-").replace("°", " deg").encode(known, "backslashreplace").decode(known)
    return text


def in_line(text: str) -> str:
    """On one line, for what a device or a file says: it must not fake another."""
    return text.replace("\n", "\\n")


def say(text: str, quiet: bool = False) -> None:
    """What is going on, as a line on stderr."""
    if not quiet:
        print(printable(text, sys.stderr.encoding), file=sys.stderr, flush=True)
