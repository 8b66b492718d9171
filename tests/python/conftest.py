"""Fixtures that several test files share."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from crawler import PATIENCE_S, Crawler, wait_for_log, write_recording
from pipefish.camera import Camera
from pipefish.cli import main
from pipefish.simulate import Scene
from rendered_survey import FRAMES, SCENE, rendered_survey

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def real_data() -> Callable[[str], Path]:
    """Gives a folder or file of the real data, which is not part of the project: in $PIPEFISH_DATA or ../shared/data.

    Where it is not, the test is skipped with a warning."""
    top = Path(os.environ.get("PIPEFISH_DATA") or ROOT.parent / "shared" / "data")

    def find(name: str) -> Path:
        if not (top / name).exists():
            warnings.warn(f"real data are not here: {name} is not in {top}; set PIPEFISH_DATA", stacklevel=2)
            pytest.skip(f"real data '{name}' are not here: set PIPEFISH_DATA")
        return top / name

    return find


@pytest.fixture(autouse=True)
def no_daemon_outlives_its_test() -> Iterator[None]:
    """Nor one that failed: two cores have no room for what goes on for ever."""
    yield
    while Crawler.made:
        crawler = Crawler.made.pop()
        if crawler.process is not None:
            crawler.kill()


@pytest.fixture
def crawler(tmp_path: Path) -> Crawler:
    """A daemon with a recording of 40 frames."""
    write_recording(tmp_path / "survey.y4m", 40)
    return Crawler(tmp_path)


@pytest.fixture
def own_keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The keys of this host are the test's own, and a busy machine may take its time over a handshake."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "host"))
    monkeypatch.setattr("pipefish.transport.CONNECT_TIMEOUT_S", PATIENCE_S)


@pytest.fixture
def device(tmp_path: Path, own_keys: None, request: pytest.FixtureRequest) -> Crawler:
    """A daemon on a network that serves until it is told to stop, with a small survey in its spool.

    Its parameter is link.keepalive_ms: after four of them in silence a host counts as gone."""
    write_recording(tmp_path / "survey.y4m", 30)
    crawler = Crawler(
        tmp_path,
        link__transport="tls",
        link__trust=tmp_path / "trust",
        link__keepalive_ms=getattr(request, "param", 5000),
        camera__profile_store=tmp_path / "profiles",
        daemon__exit_when_done="false",
        daemon__drain_s=0,
    )
    crawler.start()
    wait_for_log(crawler, "127.0.0.1:")
    return crawler


@pytest.fixture(scope="session")
def front() -> Camera:
    """A camera that many programs' models hold."""
    return Camera(
        width=800, height=600, f_u=330.5, f_v=331.25, c_u=402.25, c_v=296.5, theta_max=1.52,
        k2=-0.013, k3=0.004, k4=-0.002, k5=0.0003, name="front",
    )  # fmt: skip


@pytest.fixture(scope="session")
def measured(tmp_path_factory) -> Path:
    """A folder with survey.mcap, of rendered keyframes of the pipe of rendered_survey.py, and out/, measured from it.

    Not to be written into."""
    folder = tmp_path_factory.mktemp("rendered")
    survey = rendered_survey(Scene(SCENE), FRAMES, folder / "survey.mcap")
    assert main(["reconstruct", str(survey), "-o", str(folder / "out"), "--json"]) == 0
    return folder
