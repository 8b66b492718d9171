"""The packages for arm64, which are made on another machine: that they say what they need. Their daemon is the one that
the scenarios run; and that Debian's own tools install and start it on a board."""

from __future__ import annotations

import re
import subprocess
import time
from pathlib import Path

import pytest
from board import CACHE, PACKAGES
from crawl import Result
from test_board import SERIAL, SIZE, frames, show_beside_a_wheel, usb


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


def plug_in_what_has_another_driver(survey) -> None:
    """A driver that is loaded first by what is plugged in while the service runs: its nodes are among those that the
    unit allows. Asked of a node without a device, in the service's control group."""
    board = survey.board
    board.run("modprobe cdc_acm && grep -q '166 ttyACM' /proc/devices && mknod /dev/plugged c 166 0")
    opened = "echo $$ >/sys/fs/cgroup/system.slice/pipefishd.service/cgroup.procs; exec cat /dev/plugged"
    said = board.run(f"sh -c '{opened}' 2>&1", check=False)
    assert "No such device or address" in said, said


def show_beside_a_wheel_of_its_own_group(survey) -> int:
    """The wheel is an input, which Raspberry Pi OS gives to its own group by a rule that comes after the package's."""
    board = survey.board
    rule = 'SUBSYSTEM==\\"input\\", GROUP=\\"input\\", MODE=\\"0660\\"'
    board.run(f'modprobe uinput; modprobe evdev; echo "{rule}" >/etc/udev/rules.d/99-com.rules; udevadm control -R')
    world = show_beside_a_wheel(survey)
    board.run("udevadm settle")
    assert board.run("stat -c '%U:%G %a' /dev/input/event0").strip() == "root:pipefish 640"
    board.run(f"kill -USR1 {world}")
    return world


def restart_one_that_stands_still(survey) -> None:
    """systemd's own watchdog: it ends a daemon that does not say that it is well, and starts another."""
    board = survey.board
    before = board.run("systemctl show -P MainPID pipefishd").strip()
    board.run(f"kill -STOP {before}")
    still = "$(systemctl show -P MainPID pipefishd)"
    board.run(
        f"i=0; until [ {still} != {before} ] && [ {still} != 0 ]; do sleep 1; i=$((i+1)); [ $i -lt 90 ] || exit 1; done"
    )
    assert board.run("systemctl show -P NRestarts pipefishd").strip() == "2"


@pytest.mark.timeout(1500)  # systemd and dpkg, emulated, on a machine that is busy otherwise
def test_the_package_installed_by_dpkg_and_started_by_systemd_takes_a_survey(package: Path, crawl, note):
    """A killed daemon is started again by systemd and goes on; stopped, it drains. Its unit's fences are up."""
    survey = crawl(has_system=True, **SERIAL, **SIZE)
    board = survey.board
    survey.install(package)
    survey.wait_for("begins")
    assert "ok installed" in board.run("dpkg -s pipefishd")
    assert board.run("id -nG pipefish").split() == ["pipefish", "dialout", "video"]
    assert board.run("stat -c '%U:%G %a' /dev/gpiochip0 /var/lib/pipefish").splitlines() == [
        "root:pipefish 660",
        "pipefish:pipefish 750",
    ]
    plug_in_what_has_another_driver(survey)
    survey.start_receiver(usb(survey))
    world = show_beside_a_wheel_of_its_own_group(survey)
    survey.wait_until(frames(15), "15 frames")
    process = board.run("systemctl show -P MainPID pipefishd").strip()
    shown = board.run(f"cat /proc/{process}/status")
    assert re.search(r"NoNewPrivs:\s+1", shown) and re.search(r"CapBnd:\s+0+$", shown, re.M), shown
    assert re.search(r"Seccomp:\s+2", shown) and not re.search(r"Uid:\s+0", shown), shown
    start = time.monotonic()
    board.run(f"kill -9 {process}; rm -f /run/pipefish/status.json")
    survey.wait_for("goes on")
    recovery = time.monotonic() - start
    survey.wait_until(frames(15), "15 frames again")
    survey.hide(world)
    result = Result("package under systemd, killed", recovery_s=recovery)
    survey.measure(result, int(board.run("systemctl show -P MainPID pipefishd")))
    restart_one_that_stands_still(survey)
    board.run("systemctl stop pipefishd")
    received = survey.finish()
    assert board.run("systemctl show -P Result,NRestarts pipefishd").split() == ["success", "2"]
    board.run("cp -r /var/lib/pipefish/index /mnt/ && dpkg -r pipefishd && dpkg -P pipefishd")
    assert board.run("ls -d /var/lib/pipefish /etc/pipefish 2>/dev/null; id pipefish 2>/dev/null", check=False) == ""
    note(survey.check(received, result))
    assert [len(rows) > 0 for _, rows in survey.indices()] == [True, True, False], "the third start had no camera"
