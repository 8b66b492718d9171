"""`pipefish receive --live`: the pipe measured while its survey arrives, in a process of its own.

The receiving process only hands over what it has stored already and reads what comes back, so neither the link nor the
file depend on how fast, or whether at all, this goes. What is measured is the newest stretch, again and again, frame by
frame; each place keeps the value of the run that had it nearest to its middle, for ends are less well known."""

from __future__ import annotations

import contextlib
import math
import multiprocessing
import os
import queue
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pipefish import pipefish_pb2 as pb
from pipefish.errors import PipefishError
from pipefish.intervals import SAID, Z95
from pipefish.scene import STATES, frames_in
from pipefish.structure import REASONS
from pipefish.survey import Keyframe, Observations, Survey
from pipefish.surveywrite import OBJECT_END, OBJECT_KEYFRAME, OBJECT_START
from pipefish.terminal import one_line

WINDOW = 30  # keyframes that are measured together: 1.2 m of a DN300 pipe, one second of one core
STEP = 6  # new ones from one run to the next
LEAST = 15  # keyframes for a first try
SLIP_SHARE, SLIP_M = 0.25, 0.005  # of a step and at least: encoder and vision disagree by more, the wheel slips
NICENESS = 10
END_S = 120.0  # most time that the end waits for the last run
TOLD = ("dark", "covered", "over_exposed", "weak_texture", "encoder_contrary")  # states that are warned of
LAMP = {"dark": " (lamp out?)", "over_exposed": " (lamp too bright?)"}


# ---- in the measuring process


@dataclass
class Course:
    """What is known of one survey so far."""

    path: Path
    survey_id: bytes = b""
    starts: list[pb.SurveyStart] = field(default_factory=list)
    keyframes: dict[int, Keyframe] = field(default_factory=dict)
    places: dict[int, dict[str, Any]] = field(default_factory=dict)  # of the station's number along the pipe
    warned: dict[str, int] = field(default_factory=dict)  # kind of warning: last keyframe at which it held
    warnings: list[str] = field(default_factory=list)
    driven: dict[int, float] = field(default_factory=dict)  # chainage of keyframes, of the encoder or the pictures
    every: float = 0.0  # between places; 0: nothing is measured yet
    measured_at: int = 0  # keyframes at the last run
    why: str = ""  # the last run gave nothing
    void: bool = False  # the lens zoomed: from there on nothing is measured
    unit: str = "metre"

    def take(self, kind: int, data: bytes) -> list[str]:
        """Takes in a stored object; returns new warnings."""
        if kind == OBJECT_START:
            start = pb.SurveyStart.FromString(data)
            self.turn_to(start.survey_id)
            self.starts.append(start)
        elif kind == OBJECT_KEYFRAME:
            message = pb.Keyframe.FromString(data)
            self.turn_to(message.survey_id)
            message.ClearField("jpeg")
            seen = Observations.from_message(message.observations)
            frame = Keyframe(
                message.index, message.time.boot_id, message.time.monotonic_ns, 0, message, seen, self.path, 0
            )
            return self.add(frame)
        return []

    def add(self, frame: Keyframe) -> list[str]:
        """Takes in a keyframe; returns new warnings."""
        before = self.keyframes.get(frame.index - 1)
        self.keyframes[frame.index] = frame
        told = []
        words = dict(STATES)
        for name, frames in frames_in(frame.message.tracking).items():
            if name in TOLD and frames:
                told += self._warn(name, frame.index, words[name] + LAMP.get(name, ""))
        if before is not None and (frame.after_break or before.boot != frame.boot):
            told += self._warn(
                "break", frame.index, one_line(frame.message.break_reason) or "tracks do not go on from here"
            )
        return told

    def turn_to(self, survey_id: bytes) -> None:
        """A device may deliver what is left of an earlier survey first; the one that comes now counts."""
        if survey_id != self.survey_id:
            self.__init__(self.path, survey_id)  # type: ignore[misc]

    def _warn(self, kind: str, index: int, text: str, pause: int = 1) -> list[str]:
        """A warning, unless the same one held up to `pause` keyframes before."""
        last = self.warned.get(kind)
        self.warned[kind] = index
        if last is not None and index - last <= pause:
            return []
        line = f"{self._at(index)}: {text}"
        self.warnings.append(line)
        return [line]

    def _at(self, index: int) -> str:
        at = self.along().get(index, math.nan)
        return f"{at:.2f} m" if math.isfinite(at) else f"keyframe {index}"

    def along(self) -> dict[int, float]:
        """Chainage by the encoder of each keyframe's index."""
        survey = self._part(sorted(self.keyframes))
        return dict(zip([k.index for k in survey.keyframes], survey.chainage().tolist(), strict=True))

    def _part(self, indices: list[int]) -> Survey:
        survey = Survey(self.path)
        survey.starts, survey.keyframes = self.starts, [self.keyframes[i] for i in indices]
        return survey

    def due(self, over: bool = False) -> bool:
        """Whether there is enough for another run; over: nothing more will come."""
        count = len(self.keyframes)
        return (
            bool(self.starts) and not self.void and count >= LEAST and count - self.measured_at >= (1 if over else STEP)
        )

    def measure(self) -> list[str]:
        """Measures the next stretch; returns new warnings."""
        indices = sorted(self.keyframes)
        # All that is new, or half a window of it where more has come at once: nothing is skipped.
        self.measured_at = min(len(indices), max(self.measured_at + WINDOW // 2, LEAST))
        indices = indices[max(0, self.measured_at - WINDOW) : self.measured_at]
        try:
            return self._measure(indices)
        except PipefishError as error:
            self.why = str(error).removeprefix(f"{self.path}: ")
        except Exception as error:  # whatever it is, the next stretch is another one
            self.why = f"internal error ({type(error).__name__}: {error})"
        return self._warn("not measured", indices[-1], f"not measured: {self.why}", WINDOW)

    def _measure(self, indices: list[int]) -> list[str]:
        from pipefish.measure import measure
        from pipefish.measured_files import stations

        m = measure(self._part(indices), method="incremental", threads=1, pictures=False)
        if self.places and m.scale.unit != self.unit:  # what an encoder that stood still left is of another unit
            self.places, self.driven, self.every = {}, {}, 0.0
        self.why, self.unit = "", m.scale.unit
        told = self._warn("scale", 0, "no scale: diameters are not measured") if m.scale.unit != "metre" else []
        for gap in m.structure.gaps:
            if gap.reason == "zoom":
                self.void, self.why = True, REASONS[gap.reason]
                told += self._warn("zoom", int(m.index[gap.first]), f"not measured from here on: {self.why}")
        offset = self._offset(indices, _driven(m))
        middle = float(np.mean([self.driven[i] for i in indices if i in self.driven]))
        table = stations(m)
        self._keep(table | {"chainage": table["chainage"] + offset}, middle)
        return told + self._slips(m)

    def _offset(self, indices: list[int], driven: np.ndarray) -> float:
        """From a window's own chainage (K,) at these keyframes, NaN where it is not known, to the survey's: the
        encoder's, else that of keyframes that a window before had, too, else on from where the last one ended."""
        along = self.along()
        known = {i: along[i] if math.isfinite(along[i]) else self.driven.get(i, math.nan) for i in indices}
        apart = np.array([known[i] for i in indices]) - driven
        measured = driven[np.isfinite(driven)]
        if np.isfinite(apart).any():
            offset = float(np.nanmedian(apart))
        else:
            offset = max(self.driven.values(), default=0.0) - float(measured.min())
        for i, at in zip(indices, driven + offset, strict=True):
            at = along[i] if math.isfinite(along[i]) else float(at)
            if math.isfinite(at):
                self.driven.setdefault(i, at)
        return offset

    def _keep(self, table: dict[str, np.ndarray], middle: float) -> None:
        """Takes in stations by their chainage; middle: of the window that they are of."""
        if not self.every:  # once: with another one each time a place far along the pipe would have several numbers
            self.every = 0.25 * float(np.nanmedian(table["d_mean"]))
        for k, at in enumerate(table["chainage"]):
            if not np.isfinite(table["d_mean"][k]):
                continue
            row = {"at": float(at), "off": abs(float(at) - middle)}
            row |= {n: float(table[n][k]) for n in ("d_mean", "d_mean_sigma", "d_max", "d_min", "ovality")}
            row["systematic"] = float(table["d_mean_systematic"][k])
            number = round(at / self.every)
            if number not in self.places or self.places[number]["off"] > row["off"]:
                self.places[number] = row

    def _slips(self, m: Any) -> list[str]:
        from pipefish.measured_files import encoder_against_vision

        told: list[str] = []
        apart = encoder_against_vision(m)
        if apart is not None and m.scale.unit == "metre":
            excess, driven = np.array(apart["vision_minus_encoder"]), np.abs(np.diff(apart["chainage"]))
            slips = np.abs(np.diff(excess)) > np.maximum(SLIP_M, SLIP_SHARE * driven)
            for k in np.flatnonzero(slips):
                index = int(m.index[m.structure.frames[k + 1]])
                if index > self.warned.get("slip", -1):
                    told += self._warn("slip", index, "slip: encoder and pictures disagree about the way driven")
        return told

    def progress(self) -> dict[str, Any]:
        """The newest values, for people to look at."""
        last = max(self.keyframes, default=0)
        at = self.along().get(last, math.nan) if self.keyframes else math.nan
        behind = [p for p in self.places.values() if not math.isfinite(at) or p["at"] <= at]
        newest = max(behind, key=lambda p: p["at"], default=None)
        return {"keyframes": len(self.keyframes), "chainage": at, "newest": newest, "unit": self.unit, "why": self.why}

    def summary(self) -> dict[str, Any]:
        """Plain values of all that was measured."""
        rows = [self.places[k] for k in sorted(self.places)]
        out: dict[str, Any] = {"keyframes": len(self.keyframes), "stations": len(rows), "unit": self.unit}
        out |= {"warnings": self.warnings, "why": self.why}
        if rows:
            d = np.array([r["d_mean"] for r in rows])
            worst = max(rows, key=lambda r: r["ovality"] if math.isfinite(r["ovality"]) else -1.0)
            out |= {"from": rows[0]["at"], "to": rows[-1]["at"], "d_mean": float(d.mean())}
            out |= {"d_mean_least": float(d.min()), "d_mean_most": float(d.max())}
            out |= {"station_sigma": float(np.median([r["d_mean_sigma"] for r in rows]))}
            # Of a mean, whatever its parts have in common: not more than the mean of theirs. Neighbours of one window
            # share most, and by how much nobody asks here.
            out |= {"d_mean_sigma_most": float(np.mean([r["d_mean_sigma"] for r in rows]))}
            out |= {"systematic": float(np.mean([r["systematic"] for r in rows]))}
            if math.isfinite(worst["ovality"]):
                out |= {"ovality_most": worst["ovality"], "ovality_most_at": worst["at"]}
        return out


def _driven(m: Any) -> np.ndarray:
    """(K,) chainage of all keyframes of a measurement in its own count, NaN where it is not known."""
    out = np.full(len(m.index), np.nan)
    out[m.structure.frames] = m.frame_chainage()
    return out


def work(path: Path, inbox: Any, outbox: Any) -> None:
    """The measuring process: objects in, {"progress"}, {"warning"} and at the end {"summary"} out."""
    with contextlib.suppress(OSError):
        os.nice(NICENESS)
    course, over = Course(path), False
    try:
        while not over or course.due(over):
            told: list[str] = []
            wait = not course.due(over)
            while not over:  # all that has come
                try:
                    item = inbox.get(wait)
                except queue.Empty:
                    break
                wait = False
                if item is None:
                    over = True
                    break
                kind, data = item
                if kind == "file":
                    told += _resume(course, data)
                else:
                    told += course.take(kind, data)
            if course.due(over):
                told += course.measure()
            for text in told:
                outbox.put({"warning": text})
            outbox.put({"progress": course.progress()})
        outbox.put({"summary": course.summary()})
    except KeyboardInterrupt:
        outbox.cancel_join_thread()
    except Exception as error:  # whatever it is, reception goes on
        outbox.put({"failed": f"{type(error).__name__}: {error}"})


def _resume(course: Course, path: str) -> list[str]:
    """Takes in what an interrupted reception has left; by now the file may have got its final name."""
    try:
        survey = Survey.open(path)
    except FileNotFoundError:
        survey = Survey.open(path.removesuffix(".partial"))
    course.turn_to(bytes.fromhex(survey.survey_id))
    course.starts = list(survey.starts)
    told = []
    for frame in survey.keyframes:
        told += course.add(frame)
    return told


# ---- in the receiving process


class Live:
    """The door to the measuring process. Nothing here waits, but `finish`."""

    def __init__(self, path: Path) -> None:
        context = multiprocessing.get_context("spawn")
        self._inbox, self._outbox = context.Queue(), context.Queue()
        self._process = context.Process(target=work, args=(path, self._inbox, self._outbox), daemon=True)
        self._process.start()
        self._told_end = False
        self.progress: dict[str, Any] = {}
        self.summary: dict[str, Any] | None = None

    def resume(self, partial: Path) -> None:
        """Hands over what an interrupted reception has left in a file."""
        self._inbox.put(("file", str(partial)))

    def take(self, kind: int, data: bytes) -> None:
        """Hands over an object that has been stored."""
        if kind in (OBJECT_START, OBJECT_KEYFRAME, OBJECT_END):
            self._inbox.put((kind, data))

    def poll(self) -> list[str]:
        """Warnings that have come since; `progress` and `summary` are the newest."""
        told = []
        has_ended = not self._process.is_alive()  # asked first: what it said last is here then
        while True:
            try:
                item = self._outbox.get_nowait()
            except queue.Empty:
                break
            if "warning" in item:
                told.append(item["warning"])
            elif "failed" in item:
                told.append(f"the live measurement ended ({item['failed']}); reception goes on")
                self._told_end = True
            else:
                self.progress = item.get("progress", self.progress)
                self.summary = item.get("summary", self.summary)
        if self.summary is None and not self._told_end and has_ended:
            told.append("the live measurement ended; reception goes on")
            self._told_end = True
        return told

    def finish(self) -> list[str]:
        """Waits for the last run, at most END_S; returns the last warnings. `summary` is there unless it failed."""
        self._inbox.put(None)
        told, end = [], time.monotonic() + END_S
        while self.summary is None and not self._told_end and time.monotonic() < end:
            told += self.poll()
            time.sleep(0.02)
        self.close()
        return told

    def close(self) -> None:
        """Ends the process."""
        self._inbox.cancel_join_thread()
        if self._process.is_alive():
            self._process.terminate()
        self._process.join(5)


def progress_text(progress: dict[str, Any]) -> str:
    """One line about the newest values."""
    if not progress or not progress["keyframes"]:
        return "nothing to measure yet"
    at, newest = progress["chainage"], progress["newest"]
    where = f"{at:.2f} m" if math.isfinite(at) else f"keyframe {progress['keyframes']}"
    if newest is None:
        return f"{where}: {progress['why'] or 'not measured yet'}"
    oval = f", oval {100 * newest['ovality']:.1f} %" if math.isfinite(newest["ovality"]) else ""
    if progress["unit"] != "metre":
        return f"{where}: no scale{oval}"
    d, half = 1000 * newest["d_mean"], 1000 * Z95 * math.hypot(newest["d_mean_sigma"], newest["systematic"])
    return f"{where}: diameter {d:.1f} ± {half:.1f} mm at {newest['at']:.2f} m{oval}"


def summary_rows(summary: dict[str, Any] | None) -> list[tuple[str, object]]:
    """The end of a live measurement, for people."""
    if summary is None:
        return [("measured live", "no: it did not come to an end")]
    if not summary["stations"]:
        return [("measured live", f"nothing: {summary['why'] or 'too few keyframes'}")]
    rows: list[tuple[str, object]] = []
    if summary["unit"] == "metre":
        d, low, high = (1000 * summary[k] for k in ("d_mean", "d_mean_least", "d_mean_most"))
        rows.append(
            ("measured live", f"{summary['from']:.2f} to {summary['to']:.2f} m, {summary['stations']} stations")
        )
        own, shared = (1000 * Z95 * summary[k] for k in ("d_mean_sigma_most", "systematic"))
        parts = f"± {own:.1f} (repeatability, at most) ± {shared:.1f} (systematic: scale and camera)"
        rows += [("mean diameter", f"{d:.1f} mm {parts}"), ("along the pipe", f"{low:.1f} to {high:.1f} mm")]
    if "ovality_most" in summary:
        rows.append(("most oval", f"{100 * summary['ovality_most']:.2f} % at {summary['ovality_most_at']:.2f} m"))
    rows.append(("warnings", len(summary["warnings"]) or "none"))
    if summary["unit"] == "metre":  # without lengths there is none
        rows.append(("intervals", SAID))
    return rows
