"""An emulated arm64 board with Debian's kernel: takes commands, loses power; its USB serial line can be unplugged."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import select
import shlex
import shutil
import socket
import subprocess
import threading
import time
import tty
import warnings
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CACHE = ROOT / "build" / "board"
PROGRAMS = ROOT / "build" / "arm64"
PACKAGES = ROOT / "build" / "deb"
BOOT_S, COMMAND_S = 300, 300  # an emulated board on a busy machine may be ten times later than on an idle one
DISK_BYTES = 256 << 20


class BoardError(AssertionError):
    """The board did not do what it was told, with what it said."""


def find_daemon(folder: Path) -> Path:
    """The daemon of the arm64 package as dpkg lays it out, if that is made of the last build; else as it was built."""
    built = PROGRAMS / "firmware/pipefishd"
    packages = [p for p in PACKAGES.glob("pipefishd_*_arm64.deb") if p.stat().st_mtime >= built.stat().st_mtime]
    if not packages:
        return built
    subprocess.run(["dpkg-deb", "-x", packages[-1], folder / "package"], check=True)
    return folder / "package/usr/bin/pipefishd"


class SerialLine:
    """The host's end of one of the board's serial lines: a pseudo-terminal that stays while the line is unplugged.

    lose_every   of so many bytes from the board one is lost on the way; 0 = none
    """

    def __init__(self, socket_path: Path, lose_every: int = 0) -> None:
        self.lose_every, self._passed = lose_every, 0
        self.socket_path = socket_path
        self.master, slave = pty.openpty()
        tty.setraw(self.master)
        tty.setraw(slave)
        self._slave = slave  # keeps the terminal alive between two receivers
        self.device = os.ttyname(slave)
        self._line: socket.socket | None = None
        self._lock = threading.Lock()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._pump, daemon=True)
        self._thread.start()

    def plug(self) -> None:
        """QEMU's adapter is on the board's bus while somebody is connected to its socket."""
        line = socket.socket(socket.AF_UNIX)
        end = time.monotonic() + 60
        while True:
            try:
                line.connect(str(self.socket_path))
                break
            except OSError:
                if time.monotonic() > end:
                    raise
                time.sleep(0.05)
        with self._lock:
            self._line = line

    def unplug(self) -> None:
        with self._lock:
            line, self._line = self._line, None
        if line is not None:
            line.close()

    def _pump(self) -> None:
        while not self._over.is_set():
            with self._lock:
                line = self._line
            try:
                readable = select.select([self.master, *([line] if line else [])], [], [], 0.05)[0]
                if self.master in readable:
                    data = os.read(self.master, 65536)
                    if line:
                        line.sendall(data)
                if line in readable:
                    data = line.recv(65536)
                    if not data:
                        raise OSError
                    data = self._damage(data)
                    while data:
                        data = data[os.write(self.master, data) :]
            except (OSError, ValueError):
                if line is not None:
                    with self._lock:
                        self._line = None if self._line is line else self._line

    def _damage(self, data: bytes) -> bytes:
        if not self.lose_every:
            return data
        first = -self._passed % self.lose_every
        self._passed += len(data)
        lost = range(first, len(data), self.lose_every)
        return bytes(byte for i, byte in enumerate(data) if i not in lost)

    def flood(self, data: bytes) -> None:
        """Sends the board what nobody asked for, as fast as its device takes it, among what the host sends."""
        with self._lock:
            line = self._line
        line.sendall(data)

    def close(self) -> None:
        self._over.set()
        self._thread.join()
        self.unplug()
        os.close(self.master)
        os.close(self._slave)


class Board:
    """One board: its disk and shared folder outlive power cuts.

    folder   of this test: disk.img, share/ (the board's /mnt), console.log
    port     of the host, that leads to the board's port 7448
    has_system   Debian with systemd and dpkg instead of a shell; what it writes outside /data is lost with the power
    """

    def __init__(self, folder: Path, port: int, has_system: bool = False) -> None:
        self.folder, self.port, self.has_system = folder, port, has_system
        self.share = folder / "share"
        self.share.mkdir(parents=True)
        shutil.copy(PROGRAMS / "tests/hil/pipefish-world", self.share)
        shutil.copy(find_daemon(folder), self.share)
        self.disk = folder / "disk.img"
        with self.disk.open("wb") as disk:
            disk.truncate(DISK_BYTES)
        subprocess.run(["/sbin/mke2fs", "-q", "-t", "ext4", "-E", "lazy_itable_init=1", self.disk], check=True)
        self.initramfs = folder / "initramfs"
        archive = ["cpio", "-o", "-H", "newc", "--quiet", "-R", "0:0"]
        init = subprocess.run(
            archive, cwd=ROOT / "tests" / "hil" / "guest", input=b"init\nagent\n", capture_output=True, check=True
        )
        packed = (CACHE / "initramfs").read_bytes()
        self.initramfs.write_bytes(packed + bytes(-len(packed) % 4) + init.stdout)
        self.usb = SerialLine(folder / "usb.sock")
        self.uart = SerialLine(folder / "uart.sock")
        self.boots = 0
        self.up_s = 0.0  # of the board's time, from the kernel's start until it took commands
        self._qemu: subprocess.Popen[bytes] | None = None
        self._agent: socket.socket | None = None

    def _command(self) -> list[str]:
        return [
            *("qemu-system-aarch64", "-M", "virt", "-cpu", "cortex-a72", "-smp", "2", "-m", "512"),
            # The board's time runs with its instructions, 250 million a second: a busy host makes it late, never slow.
            # While it idles, it runs with the host's: of a time that QEMU stood still in, the board sees a jump.
            *("-accel", "tcg", "-icount", "shift=2"),
            *("-nodefaults", "-no-user-config", "-display", "none", "-no-reboot"),
            *("-serial", f"file:{self.folder}/console.log"),
            *("-kernel", str(CACHE / "vmlinuz"), "-initrd", str(self.initramfs)),
            *("-append", "console=ttyAMA0 loglevel=4 panic=-1 rdinit=/init" + " system" * self.has_system),
            *("-virtfs", f"local,path={self.share},mount_tag=host,security_model=none"),
            # What the board has flushed outlives a killed QEMU in the host's memory: the host's own disk, which may be
            # busy for seconds, is not waited for.
            *("-drive", f"file={self.disk},if=none,id=disk,format=raw,cache=unsafe"),
            *("-device", "virtio-blk-pci,drive=disk"),
            *(("-drive", f"file={CACHE}/system.img,if=none,id=system,format=raw,snapshot=on") * self.has_system),
            *(("-device", "virtio-blk-pci,drive=system") * self.has_system),
            *("-device", "virtio-serial-pci"),
            *("-chardev", f"socket,id=agent,path={self.folder}/agent.sock,server=on,wait=off"),
            *("-device", "virtserialport,chardev=agent,name=agent,nr=1"),
            *(
                "-netdev",
                f"user,id=net,hostfwd=tcp:127.0.0.1:{self.port}-:7448",
                "-device",
                "virtio-net-pci,netdev=net,romfile=",
            ),
            *("-device", "qemu-xhci", "-chardev", f"socket,id=usb,path={self.folder}/usb.sock,server=on,wait=off"),
            *("-device", "usb-serial,chardev=usb"),
            *("-chardev", f"socket,id=uart,path={self.folder}/uart.sock,server=on,wait=off"),
            *("-device", "pci-serial,chardev=uart"),  # a 16550: /dev/ttyS0
            *("-device", "i6300esb"),  # a watchdog; with -no-reboot a reset ends QEMU
        ]

    def power_on(self) -> None:
        """Boots until it takes commands."""
        for name in ("agent.sock", "usb.sock", "uart.sock"):
            (self.folder / name).unlink(missing_ok=True)
        with (self.folder / "qemu.log").open("ab") as log:
            self._qemu = subprocess.Popen(self._command(), stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        self.usb.plug()
        self.uart.plug()
        agent = socket.socket(socket.AF_UNIX)
        agent.settimeout(BOOT_S * (3 if self.has_system else 1))
        agent.connect(str(self.folder / "agent.sock"))
        self._agent = agent
        self._input = agent.makefile("rb")
        word, _, uptime = self._line().partition(" ")
        if word != "READY":
            raise BoardError("the board did not boot: " + self.console())
        self.boots, self.up_s = self.boots + 1, float(uptime)
        self.run("mkdir -p /data; mount /dev/vda /data")

    def _line(self) -> str:
        try:
            line = self._input.readline()
        except TimeoutError as error:
            raise BoardError("the board does not answer: " + self.console()) from error
        if not line:
            raise BoardError("the board has gone: " + self.console())
        return line.decode(errors="replace").strip()

    def run(self, command: str, timeout: float = COMMAND_S, check: bool = True) -> str:
        """Runs a shell command on the board; its output. With `check` a code other than 0 is an error."""
        self._agent.settimeout(timeout * (3 if self.has_system else 1))
        self._agent.sendall(command.replace("\n", " ").encode() + b"\n")
        word, code, size = self._line().split()
        assert word == "DONE"
        output = self._input.read(int(size)).decode(errors="replace")
        if check and code != "0":
            raise BoardError(f"{command}: code {code}\n{output}\n{self.console()}")
        return output

    def uptime(self) -> float:
        """Seconds of the board's time since its kernel started."""
        return float(self.run("cut -d' ' -f1 /proc/uptime"))

    def spawn(self, command: str, log: str) -> int:
        """Starts a command in the background, its output in the shared folder; returns its process id."""
        (self.share / log).touch()
        return int(self.run(f"({command}) >/mnt/{shlex.quote(log)} 2>&1 & echo $!"))

    def is_running(self, process: int) -> bool:
        return self.run(f"kill -0 {process} 2>/dev/null && echo yes", check=False).strip() == "yes"

    def wait(self, process: int, timeout: float = COMMAND_S) -> None:
        """Until a process of spawn() has ended."""
        end = time.monotonic() + timeout * (3 if self.has_system else 1)
        while self.is_running(process):
            if time.monotonic() > end:
                raise BoardError(f"process {process} does not end: {self.console()}\n{self.logs()}")
            time.sleep(0.2)

    def power_cut(self) -> None:
        """As if the plug were pulled: what the board had not written is gone."""
        self.usb.unplug()
        self.uart.unplug()
        if self._agent is not None:
            self._input.close()
            self._agent.close()
            self._agent = None
        if self._qemu is not None:
            self._qemu.kill()
            self._qemu.wait()
            self._qemu = None

    def wait_for_reset(self, timeout: float) -> float:
        """Until the board has reset itself, which leaves it off; the seconds that took."""
        start = time.monotonic()
        try:
            code = self._qemu.wait(timeout)
        except subprocess.TimeoutExpired as error:
            raise BoardError("the board does not reset: " + self.console()) from error
        self.power_cut()
        assert code == 0, f"QEMU failed with code {code}"
        return time.monotonic() - start

    def bring_newer_libcamera(self) -> bool:
        """Puts the daemon that was built with libcamera 0.3 on the board, as /mnt/newer/run. False: there is none."""
        daemon, libraries = PROGRAMS / "tests/hil/pipefishd-newer", CACHE / "libcamera-0.3/usr"
        if not daemon.exists():
            warnings.warn("NO LIBCAMERA 0.3: tools/board-image could not get Debian's backports", stacklevel=2)
            return False
        folder = self.share / "newer"
        shutil.copytree(libraries / "lib/aarch64-linux-gnu", folder, symlinks=False)
        shutil.copytree(libraries / "share/libcamera", folder / "share")
        shutil.copy(daemon, folder)
        (folder / "run").write_text(
            "export LD_LIBRARY_PATH=/mnt/newer LIBCAMERA_IPA_MODULE_PATH=/mnt/newer/libcamera "
            'LIBCAMERA_IPA_CONFIG_PATH=/mnt/newer/share\nexec /mnt/newer/pipefishd-newer "$@"\n'
        )
        return True

    def close(self) -> None:
        self.power_cut()
        self.usb.close()
        self.uart.close()

    def console(self) -> str:
        """The end of what the kernel said."""
        with contextlib.suppress(OSError):
            return (self.folder / "console.log").read_text(errors="replace")[-3000:]
        return ""

    def logs(self) -> str:
        return "\n".join(
            f"--- {p.name}\n{p.read_text(errors='replace')[-3000:]}" for p in sorted(self.share.glob("*.log"))
        )

    def status(self) -> dict:
        """The daemon's status file, {} while there is none."""
        text = self.run("cat /run/status.json", check=False)
        with contextlib.suppress(json.JSONDecodeError):
            return json.loads(text)
        return {}
