"""The packages for arm64, which are made on another machine: that they say what they need. Their daemon is the one that
the scenarios run; how they install is shown by Debian's own tools on a board, not here."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest
from board import CACHE, PACKAGES


def output(*command: object) -> str:
    return subprocess.run([str(c) for c in command], capture_output=True, text=True, check=True).stdout


@pytest.fixture(scope="module")
def package() -> Path:
    found = sorted(PACKAGES.glob("pipefishd_*_arm64.deb"))
    if not found:
        pytest.skip("NO PACKAGE FOR arm64: `make deb-arm64` makes one")
    return found[-1]


def test_the_package_depends_on_what_its_daemon_is_linked_with(package: Path, tmp_path: Path):
    output("dpkg-deb", "-x", package, tmp_path)
    assert output("dpkg-deb", "-f", package, "Architecture").strip() == "arm64"
    needed = set(re.findall(r"\(NEEDED\).*\[(.*?)\]", output("readelf", "-d", tmp_path / "usr/bin/pipefishd")))
    given: set[str] = set()
    for name in re.findall(
        r"([a-z0-9.+-]+)(?: \([^)]*\))?(?:, |$)", output("dpkg-deb", "-f", package, "Depends").strip()
    ):
        for deb in (CACHE / "apt-arm64/cache/archives").glob(f"{name}_*.deb"):
            given |= set(re.findall(r"/([^/\s]+\.so[.\d]*)", output("dpkg-deb", "-c", deb)))
    assert "libssl.so.3" in needed and needed <= given, needed - given


def test_the_package_brings_the_unit_the_user_and_the_settings(package: Path, tmp_path: Path):
    output("dpkg-deb", "-R", package, tmp_path)
    unit = (tmp_path / "usr/lib/systemd/system/pipefishd.service").read_text()
    assert "ExecStart=/usr/bin/pipefishd --config /etc/pipefish/pipefishd.ini" in unit
    assert "User=pipefish" in unit and "NoNewPrivileges=yes" in unit and "ProtectSystem=strict" in unit
    assert (tmp_path / "usr/share/pipefishd/pipefishd.ini.example").exists()
    for script in ("postinst", "prerm", "postrm"):
        assert output("sh", "-n", tmp_path / "DEBIAN" / script) == ""
        assert (tmp_path / "DEBIAN" / script).stat().st_mode & 0o111
