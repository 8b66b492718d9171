"""Pages in a headless browser: what a script finds there after the page's own scripts have run."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
import warnings
from pathlib import Path
from typing import Any

import pytest


def find_browser() -> str:
    """Chromium; without it the test is skipped with a warning."""
    for name in ("chromium", "chromium-browser", "google-chrome"):
        if path := shutil.which(name):
            return path
    warnings.warn("no chromium: the pages are not looked at; tools/install-packages test installs it", stacklevel=2)
    pytest.skip("no chromium")


def ask_page(page: Path, script: str, width: int, folder: Path, height: int = 1200) -> dict[str, Any]:
    """The object that `script`, the body of an async function, returns in a copy of the page in a window so wide."""
    browser = find_browser()
    probe = (
        "<script>window.addEventListener('load', async () => { let out;"
        f"try {{ out = await (async () => {{ {script} }})(); }} catch (e) {{ out = {{ error: String(e) }}; }}"
        "parent.postMessage(JSON.stringify(out), '*'); });</script></body>"
    )
    copy = folder / f"{page.stem}-copy.html"
    copy.write_text(page.read_text(encoding="utf-8").replace("</body>", probe), encoding="utf-8")
    frame = folder / f"{page.stem}-{width}.html"  # windows are 500 px wide at least, frames may be as narrow as phones
    frame.write_text(
        "<body style='margin:0'><script>addEventListener('message', (e) => { const p = document.createElement('pre');"
        "p.id = 'answer'; p.textContent = e.data; document.body.append(p); });</script>"
        f"<iframe src='{copy.as_uri()}' width='{width}' height='{height}' style='border:0'></iframe></body>"
    )
    command = [browser, "--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    command += ["--virtual-time-budget=20000", f"--window-size={max(width, 500)},{height}", "--dump-dom"]
    command += [f"--user-data-dir={folder / 'profile'}", frame.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    found = re.search(r'<pre id="answer">(.*?)</pre>', done.stdout, re.S)
    assert found, f"the page did not answer:\n{done.stderr[-2000:]}"
    answer = json.loads(html.unescape(found[1]))
    assert "error" not in answer, answer
    return answer
