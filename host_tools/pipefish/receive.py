"""`pipefish receive`: from the device's spool into survey files, each object on disk before it is acknowledged."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pipefish import pipefish_pb2 as pb
from pipefish.client import ACCEPT, AGAIN, STORED, Client, NoDevice, ObjectHandlers
from pipefish.errors import PipefishError
from pipefish.live import Live, progress_text
from pipefish.progress import Progress
from pipefish.surveystore import SurveyStore
from pipefish.surveywrite import (
    OBJECT_END,
    OBJECT_KEYFRAME,
    OBJECT_START,
    BootClock,
    Content,
    is_of,
    partial_of,
    read_content,
)
from pipefish.terminal import say
from pipefish.transport import Transport, TransportClosed

FIRST_ANSWERS_S = 10.0  # the first object waits this long for the device's clock and the name of its survey
SETTLE_S = 10.0  # most time for a device that is to hear that all is here
# Time after the end, and answers, for the device to take in the last acknowledgement; most time for the first of them.
LINGER_S, LINGER_ANSWERS, ANSWER_S = 3.0, 20, 30.0
SURVEY_KINDS = (OBJECT_START, OBJECT_KEYFRAME, OBJECT_END)


ASK_AGAIN_S = 0.5  # pause between the questions whether anything is left
LINE_S = 1.0  # from one line of the live measurement to the next, where there is no terminal
MISSING_NAMED = 10  # indices in a message


class Interrupted(PipefishError):
    """Stopped before the survey was complete; what has arrived is safe in the partial file."""


class Receiver(ObjectHandlers):
    """Stores what one device sends. Use `receive`."""

    def __init__(
        self,
        transport: Transport,
        store: SurveyStore,
        link: Any = None,
        quiet: bool = False,
        live: Live | None = None,
    ) -> None:
        self.store = store
        self.live = live
        self._is_live_resumed = False
        self._line: tuple[float, str] = (-LINE_S, "")  # of the live measurement: when it was last written, what
        self.client = Client(transport, self, link=link)
        self.status: pb.Status | None = None
        self._expected: int | None = None  # objects in all, as the last status had it: until the next one it stays
        self.again = 0
        self.received = 0
        self.received_bytes = 0
        self.sessions = 0
        self._clocks: dict[int, BootClock] = {}
        self._up_since = 0.0
        self._info_id: int | None = None
        self._first_object: float | None = None
        self._last_object: float | None = None
        self._clock_told_ns: int | None = None  # error of the clock that the device was told
        self._quiet = quiet
        self._is_settling = False  # nothing more is taken
        self._asked_rest: tuple[int | None, int, float] = (None, 0, 0.0)  # request, objects received then, when

    # ---- handlers

    def on_up(self, event: Any) -> None:
        self.sessions += 1
        self._up_since = time.monotonic()
        self._clock_told_ns = None
        self._info_id = self._ask(get_info=pb.Nothing())

    def on_offer(self, name: bytes, kind: int, size: int) -> int | None:
        if kind not in SURVEY_KINDS:
            # A refusal would make the device delete it.
            raise PipefishError(
                f"the device offers an object of kind {kind}, which this version of pipefish does not know; it stays "
                "on the device, update pipefish"
            )
        if self.store.has(name):
            return STORED
        return None if self._is_settling else ACCEPT

    def on_object(self, name: bytes, kind: int, data: bytes) -> int | None:
        if self.store.has(name):
            return STORED
        self._learn()
        waited = time.monotonic() - self._up_since
        if waited < FIRST_ANSWERS_S and (not self.client.has_clock or self._info_id is not None):
            return None
        stored = self.store.store(name, kind, data, self._clocks, time.time_ns())
        if not stored:
            self.again += 1
            return AGAIN
        now = time.monotonic()
        self._first_object = self._first_object or now
        self._last_object = now
        self.received += 1
        self.received_bytes += len(data)
        if self.live is not None:
            self.resume_live()
            self.live.take(kind, data)
        return STORED

    def on_status(self, status: pb.Status) -> None:
        self.status = status
        self._expected = self.received + status.spool.objects
        self.store.choose_primary(status.survey_id)
        writer = self.store.writers.get(status.survey_id)
        clock = self._clocks.get(status.time.boot_id)
        if writer is not None and clock is not None:
            writer.note_status(status, status.time.monotonic_ns + clock.offset_ns, time.time_ns())

    def _ask(self, **what: Any) -> int | None:
        """Sends a request; None if the device went away this moment: all is asked again when it is back."""
        try:
            return self.client.ask(**what)
        except NoDevice:
            return None

    def _learn(self) -> None:
        """Takes in what the link has measured and the device has said since."""
        clock = self.client.clock
        if clock is not None and self.client.boot:
            self._clocks[self.client.boot] = clock
            # The first round trips queue behind keyframes; a better one is worth telling.
            if self._clock_told_ns is None or clock.error_ns < self._clock_told_ns / 2:
                self._clock_told_ns = clock.error_ns
                self._ask(
                    clock_sync=pb.ClockSync(
                        boot_id=self.client.boot, offset_ns=clock.offset_ns, error_ns=clock.error_ns
                    )
                )
        reply = self.client.replies.pop(self._info_id, None) if self._info_id is not None else None
        if reply is not None:
            self._info_id = None
            self.store.choose_primary(reply.info.survey_id)

    # ---- the run

    @property
    def complete(self) -> bool:
        """Whether the survey that the user asked for is all here."""
        if self.store.primary is None:
            return False
        writer = self.store.writers.get(self.store.primary)
        return self.store.primary in self.store.finished or (writer is not None and writer.content.complete)

    def run(self, timeout_s: float, stop: Callable[[], bool] = lambda: False) -> None:
        """Receives until complete or `stop()`. Raises NoDevice, PipefishError, KeyboardInterrupt."""
        start = time.monotonic()
        with Progress("receiving", quiet=self._quiet) as bar:

            def done() -> bool:
                self._learn()
                completed, total = self._progress()
                bar.update(completed, self._note(start), total)
                self.show_live(bar)
                if self.complete or stop():
                    return True
                self._check_rest()
                return False

            self.client.run(done, timeout_s)
        if self.complete:
            self._linger()

    def settle(self) -> None:
        """Where an interrupted run has stored the survey's last object: tells the device, if it is there, that all is
        here. Else it would deliver the rest once more, into the next survey's files. Of another survey, which it may
        have by now, nothing is taken: it would be torn in two."""
        self._is_settling = True
        with contextlib.suppress(PipefishError):
            self.client.open()
            self.client.run(lambda: self.client.up, SETTLE_S)
            self._linger()

    def _check_rest(self) -> None:
        """Raises PipefishError if the device has nothing more to send and yet the survey is not all here.

        Asks for the device's counters where that may be so; the reply is newer than all that has been received."""
        asked, received, when = self._asked_rest
        reply = self.client.replies.pop(asked, None) if asked is not None else None
        if reply is not None and reply.HasField("status"):
            self._asked_rest = (None, 0, when)
            state, waiting = reply.status.state, reply.status.spool.objects
            if waiting == 0 and received == self.received and (state == "idle" or self._has_end()):
                raise PipefishError(self._rest_text())
        elif self.client.up and time.monotonic() - when > ASK_AGAIN_S and self._may_be_over():
            self._asked_rest = (self._ask(get_status=pb.Nothing()), self.received, time.monotonic())

    def _has_end(self) -> bool:
        writer = self.store.writers.get(self.store.primary or b"")
        return writer is not None and writer.content.end is not None

    def _may_be_over(self) -> bool:
        return self._has_end() or (self.status is not None and self.status.state == "idle")

    def _rest_text(self) -> str:
        """What is missing of the survey, and which other file has a part of it."""
        primary = self.store.primary or b""
        writer = self.store.writers.get(primary)
        have = writer.content if writer is not None else Content()
        missing = [what for what, part in (("its start", have.start), ("its end", have.end)) if part is None]
        if have.missing:
            some = ", ".join(map(str, have.missing[:MISSING_NAMED])) + (", ..." * (len(have.missing) > MISSING_NAMED))
            missing.append(f"{len(have.missing)} keyframes ({some})")
        if writer is None:
            file = partial_of(self.store.path)
            text = "the device has nothing to send: its last survey has been received before"
        else:
            file, what = writer.partial, ", ".join(missing)
            text = f"the device has nothing more to send, but the survey in {file} is not complete: {what} missing"
        others = [str(p) for p in sorted(file.parent.glob("*.partial")) if p != file and is_of(p, primary)]
        if others:
            text += f"; {' and '.join(others)} of an earlier reception of this survey may hold that"
        return text

    def _linger(self) -> None:
        """Serves the link until the device's spool is empty, so that the last acknowledgement has arrived for sure. A
        device with another survey to send says so again and again; one that says nothing may just be busy."""
        end, answers = time.monotonic() + LINGER_S, 0
        while self.client.up and (answers < LINGER_ANSWERS or time.monotonic() < end):
            asked = self._ask(get_status=pb.Nothing())
            if asked is None:  # the link takes no more questions now
                self.client.step(0.05)
                answers += 1
                continue
            latest = time.monotonic() + ANSWER_S
            while self.client.up and asked not in self.client.replies and time.monotonic() < latest:
                self.client.step(0.05)
            reply = self.client.replies.pop(asked, None)
            if reply is None or not reply.HasField("status"):
                return
            self.status, answers = reply.status, answers + 1
            if reply.status.spool.objects == 0:
                return

    def resume_live(self) -> None:
        """Once it is known which survey comes: what an interrupted run has left of it is measured before the rest."""
        writer = self.store.writers.get(self.store.primary or b"")
        if self.live is not None and writer is not None and writer.recovered and not self._is_live_resumed:
            self._is_live_resumed = True
            self.live.resume(writer.partial)

    def show_live(self, bar: Progress) -> None:
        """Warnings of the live measurement; without a terminal a line of values now and then."""
        if self.live is None:
            return
        self.resume_live()
        for warning in self.live.poll():
            bar.say(f"! {warning}")
        text, now = progress_text(self.live.progress), time.monotonic()
        if not bar.shows and text != self._line[1] and now - self._line[0] >= LINE_S and self.live.progress:
            self._line = now, text
            bar.say(text)

    def _progress(self) -> tuple[int, int | None]:
        return self.received, None if self._expected is None else max(self._expected, self.received)

    def _note(self, start: float) -> str:
        if not self.client.up:
            return "waiting for the device"
        seconds = max(time.monotonic() - (self._first_object or start), 0.1)
        if self.live is not None:
            return progress_text(self.live.progress)
        stats = self.client.link.stats
        waiting = f", {self.status.spool.objects} waiting" if self.status else ""
        return f"{self.received_bytes / seconds / 1000:.0f} kB/s{waiting}, {stats['crc_errors']} damaged frames"

    def summary(self) -> dict[str, Any]:
        """Figures of this run, as plain values."""
        stats = self.client.link.stats
        seconds = (self._last_object - self._first_object) if self._last_object and self._first_object else 0.0
        device = self.status.link if self.status else pb.Status.Link()
        return {
            "objects": self.received,
            "bytes": self.received_bytes,
            "duration_s": round(seconds, 3),
            "goodput_bytes_per_s": round(self.received_bytes / seconds) if seconds else None,
            "crc_errors_host": stats["crc_errors"],
            "crc_errors_device": device.crc_errors if self.status else None,
            "fragments_received": stats["fragments_received"],
            "fragments_duplicate": stats["fragments_duplicate"],
            "fragments_resent": device.fragments_resent if self.status else None,
            "damaged_objects": self.again,
            "sessions": stats["sessions"],
            "reconnections": self.client.reconnections,
            "rtt_ms": stats["rtt_us"] / 1000,
            "line": self.client.transport.name,
        }


def receive(
    transport: Transport,
    path: Path,
    *,
    overwrite: bool = False,
    timeout_s: float = 30.0,
    stop: Callable[[], bool] = lambda: False,
    quiet: bool = False,
    link: Any = None,
    live: bool = False,
) -> dict[str, Any]:
    """Receives one survey into `path` (docs/survey.md). Returns the summary: figures of the link and of each file.

    live       measure the pipe meanwhile, in a process of its own; lines on stderr, and "live" in the summary
    timeout_s  give up when no device answers for so long; 0 = wait for ever
    stop       asked several times a second; True ends the reception early
    Raises PipefishError (also when stopped early: Interrupted), OSError. What has arrived stays in `<path>.partial`.
    """
    store = SurveyStore(path, overwrite)
    measuring = Live(partial_of(path)) if live else None
    try:
        return _receive(Receiver(transport, store, link, quiet, measuring), timeout_s, stop, quiet)
    finally:
        if measuring is not None:
            measuring.close()


def _receive(receiver: Receiver, timeout_s: float, stop: Callable[[], bool], quiet: bool) -> dict[str, Any]:
    """The run of `receive`."""
    store = receiver.store
    receiver.resume_live()
    why = "stopped"
    try:
        if receiver.complete:
            receiver.settle()
        else:
            try:
                receiver.client.open()
            except TransportClosed as error:  # it may be about to start, or about to be plugged in
                if error.is_final:
                    raise
                say(f"{error}; waiting for it", quiet)
            receiver.run(timeout_s, stop)
    except KeyboardInterrupt:
        why = "interrupted"
    except NoDevice as error:
        why = str(error)
    except BaseException:
        receiver.client.close()
        with contextlib.suppress(OSError, PipefishError):  # the first error is the one to tell
            store.finish_complete({})
        store.close()
        raise
    receiver.client.close()
    recovered = store.recovered  # a file that is to be replaced is gone on with when the device has named its survey
    summary = receiver.summary()
    keyframes = {w.path: len(w.content.indices) for w in store.writers.values()}
    lost = {w.path: w.content.lost for w in store.writers.values()}
    damaged = [str(w.damaged) for w in store.writers.values() if w.damaged]
    try:
        finished = store.finish_complete({key: str(value) for key, value in summary.items()})
    finally:
        partial = store.close()
    file = store.finished.get(store.primary or b"")
    if file is None:
        raise Interrupted(f"{why}: {_resume_text(finished, partial, keyframes)}")
    if file not in keyframes:  # it was complete before, under another name
        content = read_content(file)
        keyframes[file], lost[file] = len(content.indices), content.lost
    live = {}
    if receiver.live is not None:
        with Progress("measuring", None, quiet) as bar:
            for warning in receiver.live.finish():
                bar.say(f"! {warning}")
            if not bar.shows:
                bar.say(progress_text(receiver.live.progress))
        live = {"live": receiver.live.summary}
    return {
        **live,
        "file": str(file),
        "keyframes": keyframes[file],
        "lost": lost[file],
        "recovered_objects": recovered,
        "damaged_copies": damaged,
        "other_surveys": [{"file": str(f), "keyframes": keyframes[f]} for f in finished if f != file],
        "incomplete_surveys": [str(p) for p in partial],
        "link": summary,
    }


def _resume_text(finished: list[Path], partial: list[Path], keyframes: dict[Path, int]) -> str:
    """What is in which file after an interruption."""
    count = {partial_of(path): number for path, number in keyframes.items()}
    done = [f"{keyframes[p]} keyframes of an earlier survey are complete in {p}" for p in finished]
    safe = [f"{count[p]} keyframes are safe in {p}" for p in partial]
    again = "the same command goes on from there" if safe else "the same command waits for the rest"
    return "; ".join([*done, *safe, again]) if done or safe else "nothing has arrived yet"
