"""The demo, short: simulator, daemon, emulated cable, reception, evaluation, page. Needs what `make build` builds, and
fails without it."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from pipefish.demo import demo
from pipefish.errors import PipefishError
from pipefish.survey import Survey

BUILD = os.environ.get("PIPEFISH_BUILD") or str(Path(__file__).resolve().parents[2] / "build" / "release")
DOORS = (
    *("frames", "fps", "keyframes_sent", "keyframes_received", "bytes", "crc_errors"),
    *("track_length_median", "track_length_p90", "within_1px", "survival"),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """One folder for all: the recording is simulated once."""
    return tmp_path_factory.mktemp("demo")


def test_a_short_demo_runs_through_the_whole_chain(folder):
    summary, page = demo(folder, frames=16, build_dir=BUILD, quiet=True)
    assert json.loads((folder / "summary.json").read_text()) == summary
    assert all(summary[door] is not None for door in DOORS)
    assert summary["frames"] == 16
    assert summary["keyframes_sent"] == summary["keyframes_received"] > 1
    assert summary["within_1px"] >= 0.95
    assert page.stat().st_size < 15 << 20
    text = page.read_text()
    assert all(f">{label}<" in text for label in ("tracking time", "transfer time"))
    assert ">goodput of the line over the transfer<" in text and "while surveying" not in text
    assert Survey.open(folder / "survey.mcap").complete


def test_a_daemon_that_fails_shows_its_log(folder, monkeypatch):
    import pipefish.demo as module

    config_text = module.config_text
    monkeypatch.setattr(module, "config_text", lambda *a: config_text(*a).replace("[spool]", "[spool]\nnonsense = 1"))
    with pytest.raises(PipefishError, match=r"(?s)pipefishd .*pipefishd\.log.*nonsense"):
        demo(folder, frames=16, build_dir=BUILD, quiet=True)


def test_the_same_recording_is_used_again_and_only_that(folder, monkeypatch):
    import pipefish.simulate
    from pipefish.demo import simulated

    class Simulated(Exception):
        pass

    def simulate(*_, **__):
        raise Simulated

    monkeypatch.setattr(pipefish.simulate, "simulate", simulate)
    recording = simulated(folder / "recording", 16, fresh=False, quiet=True)
    stamp = (folder / "recording" / "stamp.json").read_text()
    for frames, fresh in ((15, False), (16, True)):
        with pytest.raises(Simulated):
            simulated(folder / "recording", frames, fresh=fresh, quiet=True)
        (folder / "recording" / "stamp.json").write_text(stamp)
    recording.csv.write_text("changed")
    with pytest.raises(Simulated):
        simulated(folder / "recording", 16, fresh=False, quiet=True)


def test_missing_programs_are_named(tmp_path):
    with pytest.raises(PipefishError, match="pipefishd is not there; run `make build`"):
        demo(tmp_path / "d", build_dir=str(tmp_path))
