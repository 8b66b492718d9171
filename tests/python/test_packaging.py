"""What others install: the C library for CMake and pkg-config, with an example that uses nothing else."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from crawler import HEIGHT, ROOT, WIDTH, find_daemon, texture

SHIFT = 2  # px a frame


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    prefix = tmp_path_factory.mktemp("usr")
    build = find_daemon().parents[1]
    subprocess.run(["cmake", "--install", build, "--prefix", prefix, "--component", "dev"], check=True)
    return prefix


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
    command = ["cc", ROOT / "examples/track/track.c", "-o", tmp_path / "track", *flags]
    subprocess.run(command, check=True)
    check_tracks(run_on_frames(tmp_path / "track", tmp_path))


def test_the_headers_stand_alone_in_c_and_cxx(installed: Path, tmp_path: Path):
    headers = sorted((installed / "include").rglob("*.h"))
    assert len(headers) >= 9
    for compiler, suffix in (("cc", "c"), ("c++", "cpp")):
        for header in headers:
            source = tmp_path / f"one.{suffix}"
            source.write_text(f"#include <{header.relative_to(installed / 'include')}>\n")
            command = [compiler, "-Wall", "-Wextra", "-Werror", f"-I{installed / 'include'}", "-fsyntax-only", source]
            subprocess.run(command, check=True)


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd here")
def test_the_unit_is_one_that_systemd_understands(tmp_path: Path):
    unit = (find_daemon().parents[1] / "packaging" / "pipefishd.service").read_text()
    (tmp_path / "pipefishd.service").write_text(re.sub(r"ExecStart=\S+", "ExecStart=/bin/true", unit))
    command = ["systemd-analyze", "verify", "--man=no", tmp_path / "pipefishd.service"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0 and "pipefishd" not in done.stderr, done.stderr
