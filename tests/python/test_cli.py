"""The command line: exit codes, one JSON document, one clear line on errors, atomic outputs."""

from __future__ import annotations

import argparse
import io
import json
import os
import subprocess
import sys

import pytest
from pipefish._engine import Link

from device import ROLE_DEVICE, Device
from pipefish import cli, progress
from pipefish import pipefish_pb2 as pb
from pipefish.camera import Camera
from pipefish.client import OFFER, REFUSE
from pipefish.live import Course
from pipefish.survey import Survey
from pipefish.surveywrite import OBJECT_KEYFRAME
from pipefish.terminal import printable
from synthetic import SURVEY, keyframe, start, survey_objects, write_survey


def names_of(parser, before=()):
    """The words of each command below a parser, down to those that have no commands of their own."""
    below = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
    return [w for a in below for name, p in a.choices.items() for w in names_of(p, (*before, name))] or [list(before)]


COMMANDS = names_of(cli.build_parser())


@pytest.fixture
def survey(tmp_path):
    write_survey(tmp_path / "a.mcap", 6)
    return tmp_path / "a.mcap"


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_an_example(command, capsys):
    assert cli.main([*command, "--help"]) == 0
    text = capsys.readouterr().out
    assert "pipefish " + " ".join(command) in text.partition("\nexample:\n")[2] and "--json" in text


@pytest.mark.parametrize(
    "arguments", [[], ["fly"], ["info"], ["show", "x.mcap"], ["receive", "tty", "-o", "x", "--timeout", "-1"]]
)
def test_wrong_usage_is_2(arguments, capsys):
    assert cli.main(arguments) == 2
    assert capsys.readouterr().out == ""
    assert cli.main([*arguments, "--json"]) == 2
    captured = capsys.readouterr()
    error = json.loads(captured.out)["error"]
    assert (error["exit_code"], error["kind"]) == (2, "UsageError") and error["message"] in captured.err


def test_info_tells_the_survey(survey, capsys):
    assert cli.main(["info", str(survey)]) == 0
    text = capsys.readouterr().out
    assert "test pipe" in text and "0.25 m" in text and "DN300" in text
    assert cli.main(["info", str(survey), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["keyframes"] == 6 and document["complete"] and document["length_m"] == pytest.approx(0.25)


def test_texts_of_a_survey_cannot_steer_the_terminal(tmp_path, capsys):
    """Whoever made the file: escape sequences retitle and clear terminals, line breaks fake rows."""
    name = "\x1b]0;mine\x07\x1b[2Jpipe\nstate  complete\u202e"
    write_survey(tmp_path / "a.mcap", objects=[start(name=name), *survey_objects(2)[1:]])
    assert cli.main(["info", str(tmp_path / "a.mcap")]) == 0
    text = capsys.readouterr().out
    assert text.startswith("survey") and r"\u001b]0;mine\u0007\u001b[2Jpipe\nstate  complete\u202e" in text
    assert cli.main(["info", str(tmp_path / "\x1b[31mred.mcap")]) == 1
    assert r"\u001b[31mred.mcap" in capsys.readouterr().err
    assert cli.main(["info", str(tmp_path / "a.mcap"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["name"] == name


def test_show_writes_what_it_says(survey, tmp_path, capsys):
    out = tmp_path / "o.png"
    assert cli.main(["show", str(survey), "-o", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"file": str(out), "kind": "overlay", "bytes": out.stat().st_size}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["info", "nothing.mcap"], "nothing.mcap: No such file"),
        (["reconstruct", "c.mcap", "-o", "m"], "c.mcap: No such file or directory; c.mcap.partial is there"),
        (["info", "junk.mcap"], "junk.mcap: offset 0: not an MCAP file"),
        (["show", "a.mcap", "-o", "no/such/folder/o.png"], "pipefish: no/such/folder/o.png: No such file"),
        (["show", "a.mcap", "-o", "a.mcap/o.png"], "pipefish: a.mcap/o.png: Not a directory"),
        (["receive", "http://x", "-o", "b.mcap"], "'http://x' is no device"),
        (["receive", "10.0.0.7:7447", "-o", "b.mcap"], "'10.0.0.7:7447' is no device; write"),
        (["status", "10.0.0.7"], "'10.0.0.7' is no device; write"),
        (["receive", "tcp://127.0.0.1:1", "-o", "a.mcap"], "a.mcap exists already"),
        (["receive", "tcp://127.0.0.1:1", "-o", ".", "--overwrite"], ". is a folder; name a file in it"),
        (["receive", "tcp://127.0.0.1:1", "-o", "a.mcap/b.mcap"], "a.mcap is not a folder"),
        (["receive", "tcp://127.0.0.1:1", "-o", "b.mcap", "--timeout", "0.1", "--json"], "(waited 0.1 s): Connection"),
        (["status", "tcp://127.0.0.1:1"], "Connection refused"),
        (["profile", "check", "junk.mcap"], "junk.mcap"),
        (["profile", "check", "junk.mcap", "--json"], "junk.mcap"),
        (["info", "junk.mcap", "--json"], "offset 0"),
        (["undistort", "junk.mcap", "--profile", "none.json", "-o", "o.png", "--json"], "none.json: No such file"),
        (["status", "tcp://127.0.0.1:1", "--json"], "Connection refused"),
        (["flash", "tcp://127.0.0.1:1", "--json"], "Connection refused"),
    ],
)
def test_failure_is_1_with_one_clear_line(survey, tmp_path, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "junk.mcap").write_bytes(b"junk, and not little of it")
    (tmp_path / "c.mcap.partial").write_bytes(b"")
    before = {p: p.read_bytes() for p in tmp_path.iterdir()}
    assert cli.main(arguments) == 1
    captured = capsys.readouterr()
    assert captured.err.startswith("pipefish: ") and captured.err.count("\n") == 1
    assert words in captured.err
    if "--json" in arguments:
        error = json.loads(captured.out)["error"]
        assert error["exit_code"] == 1 and f"pipefish: {error['message']}\n" == captured.err
    else:
        assert captured.out == ""
    assert {p: p.read_bytes() for p in tmp_path.iterdir()} == before, "nothing half-written"


def test_a_failure_in_json_names_file_and_place(tmp_path, capsys):
    (tmp_path / "c.json").write_text('{"format": "pipefish-profile", "version": 2, "widht": 3}')
    assert cli.main(["profile", "show", str(tmp_path / "c.json"), "--json"]) == 1
    error = json.loads(capsys.readouterr().out)["error"]
    assert (error["kind"], error["file"], error["position"]) == ("ProfileError", str(tmp_path / "c.json"), "widht")


def test_convert_writes_binary_only_where_the_name_says_so(tmp_path, capsys):
    camera = Camera(width=640, height=480, f_u=200.5, f_v=201.0, c_u=319.0, c_v=241.0, theta_max=1.2)
    camera.save(tmp_path / "c.json")
    for name in ("c.yaml", "c", "c.txt"):
        assert cli.main(["profile", "convert", str(tmp_path / "c.json"), str(tmp_path / name)]) == 2
        assert "give --to" in capsys.readouterr().err and not (tmp_path / name).exists()
    assert cli.main(["profile", "convert", str(tmp_path / "c.json"), str(tmp_path / "c.bin")]) == 0
    assert (tmp_path / "c.bin").read_bytes() == camera.to_binary()
    assert cli.main(["profile", "convert", str(tmp_path / "c.json"), str(tmp_path / "c.y"), "--to", "ros"]) == 0


def test_debug_shows_where(tmp_path):
    with pytest.raises(FileNotFoundError):
        cli.main(["info", str(tmp_path / "nothing"), "--debug"])


def test_receive_and_status_from_the_command_line(tmp_path, capsys):
    with Device(survey_objects(4), SURVEY) as device:
        assert cli.main(["status", device.address, "--timeout", "60", "--json"]) == 0
        status = json.loads(capsys.readouterr().out)
        assert status["info"]["software"] == "test device" and status["status"]["spool"]["objects"] == 6
        assert status["info"]["survey_id"] == SURVEY.hex() and len(status["info"]["boot_id"]) == 16
        assert len(device.spool) == 6, "asking takes nothing from the device"
        assert cli.main(["receive", device.address, "-o", str(tmp_path / "r.mcap"), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["keyframes"] == 4 and document["link"]["crc_errors_host"] == 0
    assert Survey.open(tmp_path / "r.mcap").complete


def test_profiles_convert_there_and_back(tmp_path, capsys):
    camera = Camera(
        width=640, height=480, f_u=200.5, f_v=201.0, c_u=319.0, c_v=241.0, k2=0.01, theta_max=1.6, name="lens"
    )
    camera.save(tmp_path / "c.json")
    assert cli.main(["profile", "convert", str(tmp_path / "c.json"), str(tmp_path / "c.profile")]) == 0
    assert (tmp_path / "c.profile").read_bytes() == camera.to_binary()
    assert cli.main(["profile", "convert", str(tmp_path / "c.profile"), str(tmp_path / "d.json")]) == 0
    assert (tmp_path / "d.json").read_bytes() == (tmp_path / "c.json").read_bytes()
    capsys.readouterr()
    assert cli.main(["profile", "show", str(tmp_path / "c.profile"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["f_u"] == 200.5
    assert cli.main(["profile", "check", str(tmp_path / "c.json")]) == 0
    assert "valid" in capsys.readouterr().out


def test_help_imports_nothing_heavy():
    code = (
        "import sys; from pipefish.cli import main; main(['--help']); "
        "heavy = ('numpy', 'google.protobuf', 'PIL', 'plotly', 'rich', 'mcap', 'pipefish._engine'); "
        "print([m for m in heavy if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_help_comes_on_a_terminal_without_the_letters():
    """It was an internal error."""
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    code = "from pipefish.cli import main; raise SystemExit(main(['reconstruct', '--help']))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert done.returncode == 0 and "[+- 1 %]" in " ".join(done.stdout.split()) and not done.stderr


def test_a_terminal_without_the_letters_gets_others():
    """It would have got a traceback, after minutes of measuring."""
    assert printable("29.9 ± 0.25°, größer", "ascii") == "29.9 +- 0.25 deg, gr\\xf6\\xdfer"
    assert printable("± 1 in \udcff.csv", "utf-8") == "± 1 in \\udcff.csv", "a name that is no text takes no ± away"
    assert printable("29.9 ± 0.25°", "latin-1") == printable("29.9 ± 0.25°") == "29.9 ± 0.25°"


EVIL = "no\npipefish: survey.mcap is complete\x1b[2J"


class Liar(Device):
    """Says the same to whatever it is asked."""

    def __init__(self) -> None:
        super().__init__([], SURVEY)
        self.link = Link(role=ROLE_DEVICE, nonce=7, boot_id=1, schema=1, max_control=1000, max_object=1 << 16)

    def _control(self, request: pb.Request) -> None:
        reply = pb.Reply(id=request.id, error=EVIL)
        reply.profile.problem = EVIL
        if request.WhichOneof("what") in ("get_profile", "get_status"):
            reply.error = ""
        self.link.send_control(reply.SerializeToString())

    def _event(self, event) -> None:
        if event.type == OFFER:
            self.link.answer_object(event.slot, REFUSE)
        super()._event(event)


@pytest.mark.parametrize("command", ["status", "record", "flash"])
def test_a_device_s_words_are_no_line_of_their_own(command: str, tmp_path, front: Camera, capsys):
    (tmp_path / "camera.json").write_text(front.to_json())
    more = {"record": ["-o", str(tmp_path / "out"), "--every", "0"], "flash": [str(tmp_path / "camera.json")]}
    with Liar() as device:
        assert cli.main([command, device.address, *more.get(command, [])]) == 1
    told = capsys.readouterr().err
    assert "no\\npipefish: survey.mcap is complete\\u001b[2J" in told
    assert not any(line.startswith("pipefish: survey.mcap") for line in told.splitlines())


def test_a_device_s_words_in_a_live_warning_are_no_line_of_their_own(tmp_path):
    course, told = Course(tmp_path / "a.mcap"), []
    for index in range(2):
        message = pb.Keyframe.FromString(keyframe(index)[2])
        message.after_break, message.break_reason = index == 1, EVIL
        told += course.take(OBJECT_KEYFRAME, message.SerializeToString())
    assert told == ["keyframe 1: " + EVIL.replace("\n", "\\n")]


class Terminal(io.StringIO):
    """That rich takes for one."""

    encoding = "utf-8"

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("stream", [io.StringIO, Terminal])
def test_what_is_told_meanwhile_commands_no_terminal(stream, monkeypatch):
    """A device's words stand in warnings of the live measurement; they could have cleared the screen, and words in
    square brackets ended the bar."""
    monkeypatch.setattr(progress, "SHOW_AFTER_S", -1.0)
    monkeypatch.setattr(sys, "stderr", stream())
    monkeypatch.setenv("TERM", "xterm")
    with progress.Progress("measuring", 2) as bar:
        bar.update(1, "note \x1b[2J [/b]")
        bar.say("line \x1b[2J [/b]")
    told = sys.stderr.getvalue()
    assert "line \\u001b[2J [/b]" in told and "\x1b[2J" not in told
    assert ("note \\u001b[2J [/b]" in told) is (stream is Terminal)
