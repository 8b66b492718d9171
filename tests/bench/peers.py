"""The Python interpreters that have libraries to compare with; `make bench` installs what they need."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

#: Debian's Python has Debian's OpenCV and mrcal; the other has what pip brings (tools/requirements-peers.txt).
PEERS = {"debian": Path("/usr/bin/python3"), "pip": ROOT / "build" / "venv-peers" / "bin" / "python"}
