"""What `make deb` makes for this machine, unpacked by dpkg and used from there: daemon and host tools take a survey
together; the C library is found by CMake and by pkg-config, with an example that uses nothing else."""

from __future__ import annotations

import re
import shutil
import subprocess
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

from crawler import HEIGHT, PATIENCE_S, ROOT, WIDTH, Crawler, texture
from pipefish.survey import Survey

SHIFT = 2  # px a frame
VERSION = metadata.version("pipefish")
DAEMON, LIBRARY, HOST = "pipefishd", "libpipefish-dev", "pipefish"
HEADERS = {p.name for p in (ROOT / "lib/include/pipefish").glob("*.h")} - {"messages.h"}  # its codec is the daemon's
pytestmark = pytest.mark.skipif(shutil.which("dpkg-shlibdeps") is None, reason="NO PACKAGES: this is no Debian")


def output(*command: object, **options) -> str:
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True, **options)
    assert done.returncode == 0, f"{command}: {done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Of what `make build` has built."""
    folder = tmp_path_factory.mktemp("deb")
    output("make", "-C", ROOT, "deb-built", f"DEB={folder}")
    return {output("dpkg-deb", "-f", deb, "Package").strip(): deb for deb in folder.glob("*.deb")}


@pytest.fixture(scope="module")
def root(packages: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A root folder with all of them and nothing else, unpacked by dpkg, which allows no file in two of them. Not
    configured: that makes a user (tests/hil)."""
    folder = tmp_path_factory.mktemp("root")
    (folder / "var/lib/dpkg/info").mkdir(parents=True)
    (folder / "var/lib/dpkg/updates").mkdir()
    (folder / "var/lib/dpkg/status").touch()
    forced = "--force-not-root,unsafe-io,bad-path"  # of an ordinary user, and of what need not outlive a power cut
    output("dpkg", f"--root={folder}", "--log=/dev/null", forced, "--unpack", *packages.values())
    return folder


@pytest.fixture(scope="module")
def installed(root: Path) -> Path:
    return root / "usr"


def contents(deb: Path) -> dict[str, str]:
    """The files of a package, as /path: mode; all of them must be root's."""
    rows = [line.split(maxsplit=5) for line in output("dpkg-deb", "-c", deb).splitlines()]
    assert {owner for _, owner, *_ in rows} == {"root/root"}
    return {row[5].removeprefix("."): row[0] for row in rows if not row[0].startswith("d")}


def fields(deb: Path) -> dict[str, str]:
    return dict(re.findall(r"^([A-Z][\w-]*): (.*)$", output("dpkg-deb", "-f", deb), re.M))


def test_the_packages_are_of_this_machine_and_this_version(packages: dict[str, Path]):
    assert set(packages) == {DAEMON, LIBRARY, HOST}
    for name, deb in packages.items():
        said = fields(deb)
        assert said["Version"] == VERSION
        assert said["Architecture"] == output("dpkg", "--print-architecture").strip()
        assert said["Maintainer"] and said["Description"]
        assert contents(deb)[f"/usr/share/doc/{name}/copyright"] == "-rw-r--r--"


def test_the_daemons_package_brings_its_unit_rules_settings_and_scripts(packages: dict[str, Path], tmp_path: Path):
    assert contents(packages[DAEMON]) == {
        "/usr/bin/pipefishd": "-rwxr-xr-x",
        "/usr/lib/systemd/system/pipefishd.service": "-rw-r--r--",
        "/usr/lib/udev/rules.d/60-pipefishd.rules": "-rw-r--r--",
        "/usr/share/pipefishd/pipefishd.ini.example": "-rw-r--r--",
        "/usr/share/doc/pipefishd/copyright": "-rw-r--r--",
    }
    output("dpkg-deb", "-e", packages[DAEMON], tmp_path)
    for script in ("postinst", "prerm", "postrm"):  # these make the user, stop the service and clean up
        assert (tmp_path / script).read_text() == (ROOT / "packaging" / script).read_text()
        assert (tmp_path / script).stat().st_mode & 0o777 == 0o755
    assert "adduser" in fields(packages[DAEMON])["Depends"]


@pytest.mark.parametrize(("script", "argument"), [("postinst", "configure"), ("prerm", "remove"), ("postrm", "remove")])
def test_a_service_that_does_not_start_or_stop_leaves_no_package_half_installed(
    tmp_path: Path, script: str, argument: str
):
    text = (ROOT / "packaging" / script).read_text()
    for folder in ("/run/", "/etc/", "/usr/share/"):
        text = text.replace(f" {folder}", f" {tmp_path}{folder}")
    for folder in ("run/systemd/system", "run/udev", "etc/pipefish", "bin"):
        (tmp_path / folder).mkdir(parents=True)
    settings = tmp_path / "etc/pipefish/pipefishd.ini"
    settings.write_text("[survey]\nname = mine\n")
    for name, code in (("getent", 0), ("adduser", 0), ("udevadm", 1), ("systemctl", 1)):
        (tmp_path / "bin" / name).write_text(f"#!/bin/sh\necho {name} $* >>{tmp_path}/called\nexit {code}\n")
        (tmp_path / "bin" / name).chmod(0o755)
    output("sh", "-c", text, script, argument, env={"PATH": f"{tmp_path}/bin:/usr/bin:/bin"})
    assert "systemctl" in (tmp_path / "called").read_text()
    assert settings.read_text() == "[survey]\nname = mine\n", "an upgrade keeps the settings"


def test_the_librarys_package_brings_every_header_and_what_finds_it(packages: dict[str, Path]):
    files = contents(packages[LIBRARY])
    assert set(files.values()) == {"-rw-r--r--"}
    headers = {Path(f).name for f in files if f.startswith("/usr/include/pipefish/")}
    assert headers == HEADERS and len(headers) >= 9
    others = {Path(f).name for f in files} - headers
    cmake = {"pipefishConfig.cmake", "pipefishConfigVersion.cmake", "pipefishConfig-release.cmake"}
    assert others == {"libpipefish.a", "pipefish.pc", "copyright", "track.c", "CMakeLists.txt"} | cmake


def test_the_host_tools_package_brings_all_of_the_python_package(packages: dict[str, Path]):
    files = contents(packages[HOST])
    assert files["/usr/bin/pipefish"] == "-rwxr-xr-x"
    folder = ROOT / "host_tools"
    ours = {f"/usr/lib/pipefish/{p.relative_to(folder)}" for p in (folder / "pipefish").rglob("*.py")}
    assert len(ours) > 50 and ours <= set(files)
    assert any(re.fullmatch(r"/usr/lib/pipefish/pipefish/_engine\..*\.so", f) for f in files)
    assert not any("__pycache__" in f or "editable" in f for f in files)


def test_the_packages_depend_on_what_their_programs_are_linked_with(packages: dict[str, Path], root: Path):
    """Asked of this machine, on which they were linked: who brings each library."""
    engines = list((root / "usr/lib/pipefish/pipefish").rglob("*.so"))
    for name, programs in ((DAEMON, [root / "usr/bin/pipefishd"]), (HOST, engines)):
        depends = set(re.findall(r"(?:^|, )([a-z0-9.+-]+)", fields(packages[name])["Depends"]))
        needed = {lib for p in programs for lib in re.findall(r"\(NEEDED\).*\[(.*?)\]", output("readelf", "-d", p))}
        assert "libc.so.6" in needed and len(needed) > 3
        found = [line.split(": ") for line in output("dpkg", "-S", *(f"*/{lib}" for lib in needed)).splitlines()]
        for library in needed:
            owners = {owner.partition(":")[0] for owner, path in found if Path(path).name == library}
            assert owners & depends, f"{name} needs {library} of {owners}"


def test_daemon_and_host_tools_of_the_packages_take_a_survey(root: Path, tmp_path: Path):
    host, daemon = root / "usr/bin/pipefish", root / "usr/bin/pipefishd"
    assert output(daemon, "--version") == f"pipefishd {VERSION}\n" and "usage: pipefishd" in output(daemon, "--help")
    assert output(host, "--version") == f"pipefish {VERSION}\n" and "usage: pipefish" in output(host, "--help")
    output(host, "simulate", ROOT / "tests/hil/crawl.toml", "-o", tmp_path / "survey", cwd=tmp_path)
    crawler = Crawler(tmp_path)
    crawler.program = daemon
    crawler.start()
    device, survey = f"tcp://127.0.0.1:{crawler.port}", tmp_path / "survey.mcap"
    output(host, "receive", device, "-o", survey, cwd=tmp_path, timeout=2 * PATIENCE_S)
    assert crawler.wait() == 0
    received = Survey.open(survey)
    assert received.complete and len(received.keyframes) > 5


def run_on_frames(program: Path, folder: Path) -> list[list[str]]:
    for i in range(6):
        pixels = np.ascontiguousarray(np.roll(texture(1), -SHIFT * i, axis=1)[:, :WIDTH])
        (folder / f"{i}.pgm").write_bytes(b"P5\n%d %d\n255\n" % (WIDTH, HEIGHT) + pixels.tobytes())
    frames = sorted(folder.glob("*.pgm"))
    out = subprocess.run([program, *frames], capture_output=True, text=True, check=True).stdout
    return [line.split() for line in out.splitlines()]


def check_tracks(lines: list[list[str]]) -> None:
    """Tracks that lived through all frames moved as the pictures did."""
    whole = [line for line in lines if line[1] == "5"]
    assert len(whole) > 50
    moved = np.array([[float(x) for x in line[2:6]] for line in whole])
    assert np.abs(moved[:, 2] - moved[:, 0] + 5 * SHIFT).max() < 0.5
    assert np.abs(moved[:, 3] - moved[:, 1]).max() < 0.5


def test_the_example_builds_against_the_installed_library_by_cmake_and_tracks(installed: Path, tmp_path: Path):
    source = installed / "share/doc/libpipefish-dev/examples/track"
    configure = ["cmake", "-S", source, "-B", tmp_path / "build", f"-DCMAKE_PREFIX_PATH={installed}"]
    subprocess.run([*configure, "-DCMAKE_BUILD_TYPE=Release"], check=True, capture_output=True)
    subprocess.run(["cmake", "--build", tmp_path / "build"], check=True, capture_output=True)
    check_tracks(run_on_frames(tmp_path / "build" / "track", tmp_path))


def test_pkg_config_finds_the_library_where_it_was_installed(installed: Path, tmp_path: Path):
    pc = next(installed.rglob("pipefish.pc"))
    flags = subprocess.run(
        ["pkg-config", "--cflags", "--libs", "pipefish"],
        env={"PKG_CONFIG_PATH": str(pc.parent), "PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    source = installed / "share/doc/libpipefish-dev/examples/track/track.c"
    command = ["cc", source, "-o", tmp_path / "track", *flags]
    subprocess.run(command, check=True)
    check_tracks(run_on_frames(tmp_path / "track", tmp_path))
    for arguments, code, told in [((), 2, "usage"), (("--profile", "a"), 2, "usage"), (("no.pgm",), 1, "No such file")]:
        done = subprocess.run([tmp_path / "track", *arguments], capture_output=True, text=True)
        assert done.returncode == code and told in done.stderr


def test_the_headers_stand_alone_in_c_and_cxx(installed: Path, tmp_path: Path):
    headers = sorted((installed / "include").rglob("*.h"))
    assert {h.name for h in headers} == HEADERS
    for compiler, suffix in (("cc", "c"), ("c++", "cpp")):
        for header in headers:
            source = tmp_path / f"one.{suffix}"
            source.write_text(f"#include <{header.relative_to(installed / 'include')}>\n")
            command = [compiler, "-Wall", "-Wextra", "-Werror", f"-I{installed / 'include'}", "-fsyntax-only", source]
            subprocess.run(command, check=True)


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd here")
def test_the_unit_is_one_that_systemd_understands(installed: Path, tmp_path: Path):
    unit = (installed / "lib/systemd/system/pipefishd.service").read_text()
    assert "ExecStart=/usr/bin/pipefishd " in unit and "User=pipefish\n" in unit
    (tmp_path / "pipefishd.service").write_text(re.sub(r"ExecStart=\S+", "ExecStart=/bin/true", unit))
    command = ["systemd-analyze", "verify", "--man=no", tmp_path / "pipefishd.service"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0 and "pipefishd" not in done.stderr, done.stderr
