"""Small surveys made up for tests: objects as a device would send them, with pictures and tracks that fit together."""

from __future__ import annotations

import hashlib
import io
import math

import numpy as np
from PIL import Image

from pipefish import pipefish_pb2 as pb
from pipefish.surveystore import SurveyStore
from pipefish.surveywrite import OBJECT_END, OBJECT_KEYFRAME, OBJECT_START, BootClock

SURVEY = bytes(range(16))
BOOT = 0xFEDCBA9876543210
Object = tuple[bytes, int, bytes]  # name, kind, bytes


def name_of(data: bytes) -> bytes:
    """SHA-256, the name of an object."""
    return hashlib.sha256(data).digest()


def as_object(kind: int, message) -> Object:
    data = message.SerializeToString()
    return name_of(data), kind, data


def picture(width: int, height: int, seed: int) -> bytes:
    """A round grey picture with noise, as JPEG."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width]
    radius = np.hypot(x - width / 2, y - height / 2)
    grey = np.clip(90 + 40 * np.sin(radius / 5 + seed) + rng.normal(0, 8, (height, width)), 0, 255)
    grey[radius > min(width, height) / 2] = 0
    out = io.BytesIO()
    Image.fromarray(grey.astype(np.uint8), "L").save(out, "JPEG", quality=80)
    return out.getvalue()


def start(survey: bytes = SURVEY, boot: int = BOOT, name: str = "test pipe") -> Object:
    message = pb.SurveyStart(survey_id=survey, name=name, software="pipefishd test", width=160, height=120)
    message.time.boot_id, message.time.monotonic_ns = boot, 1_000_000_000
    message.frame_rate, message.source, message.nominal_diameter_m = 25.0, "synthetic", 0.3
    message.encoder.metres_per_count = 0.001
    return as_object(OBJECT_START, message)


def keyframe(index: int, survey: bytes = SURVEY, boot: int = BOOT, tracks: int = 40, first: int = 0) -> Object:
    """Tracks move outwards from the centre; one in four is new in each keyframe. `first`: index of the boot's first."""
    step = index - first
    message = pb.Keyframe(survey_id=survey, index=index, frame_sequence=index * 5, width=160, height=120)
    message.time.boot_id, message.time.monotonic_ns = boot, 2_000_000_000 + step * 200_000_000
    message.jpeg, message.jpeg_quality = picture(160, 120, index), 80
    message.cause = 1 if step == 0 else 2
    message.after_break = step == 0
    message.telemetry.encoder_count = 50 * index
    previous = 0
    for k in range(tracks):
        ident = step * (tracks // 4) + k + 1
        born = max(0, -((tracks - ident) // (tracks // 4)))
        age = (step - born) * 5
        angle = ident * 2.399963
        radius = 12 + (ident * 7 % 23) + age * 0.6
        obs = message.observations
        obs.id_delta.append(ident - previous)
        obs.x_q16.append(round((80 + radius * math.cos(angle)) * 65536))
        obs.y_q16.append(round((60 + radius * math.sin(angle)) * 65536))
        obs.cov_xx_q20.append(10000)
        obs.cov_xy_q20.append(-500)
        obs.cov_yy_q20.append(12000)
        obs.age.append(age)
        obs.quality.append(31000)
        obs.status.append(1 if age == 0 else 2)
        previous = ident
    return as_object(OBJECT_KEYFRAME, message)


def end(keyframes: int, survey: bytes = SURVEY, boot: int = BOOT, lost: tuple[int, ...] = ()) -> Object:
    message = pb.SurveyEnd(
        survey_id=survey, keyframes=keyframes, frames=keyframes * 5, boots=1, reason="end of recording"
    )
    message.time.boot_id, message.time.monotonic_ns = boot, 60_000_000_000
    message.lost_first.extend(lost)
    message.lost_count.extend(1 for _ in lost)
    message.last_status.frames = keyframes * 5
    message.last_status.fps = 31.5
    message.last_status.stage.track = 4200.0
    return as_object(OBJECT_END, message)


def survey_objects(keyframes: int = 12, **options) -> list[Object]:
    """Start, keyframes, end of one survey."""
    return [start(**options), *(keyframe(i, **options) for i in range(keyframes)), end(keyframes, **options)]


CLOCK = {BOOT: BootClock(1_700_000_000_000_000_000, 50_000)}


def store_all(store: SurveyStore, objects: list[Object], now: int = 1_700_000_100_000_000_000) -> None:
    for i, (name, kind, data) in enumerate(objects):
        assert store.store(name, kind, data, CLOCK, now + i * 1_000_000)


def write_survey(path, keyframes: int = 12, objects: list[Object] | None = None) -> None:
    """A finished survey file."""
    store = SurveyStore(path)
    store_all(store, objects or survey_objects(keyframes))
    assert store.finish_complete({"line": "test"})
