"""A reader of binary profiles, written from lib/profile/SPEC.md alone: nothing of Pipefish is used."""

from __future__ import annotations

import struct
from typing import Any

ARRAYS = {"asym_radial_theta": 272, "asym_radial_phi": 296, "asym_tangential_theta": 328, "asym_tangential_phi": 352}


def crc32c(data: bytes) -> int:
    """RFC 3720 B.4, bit by bit."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x82F63B78 if crc & 1 else 0)
    return crc ^ 0xFFFFFFFF


def text(data: bytes, at: int, size: int) -> str:
    """A text of a field; the zeros behind it belong to the format."""
    field = data[at : at + size]
    value = field.rstrip(b"\0")
    assert len(value) < size and b"\0" not in value
    return value.decode("utf-8")


def numbers(data: bytes, at: int, count: int) -> tuple[float, ...]:
    """`count` doubles."""
    return struct.unpack_from(f"<{count}d", data, at)


def read(data: bytes) -> dict[str, Any]:
    """All fields of a profile; residuals that are unknown are None."""
    magic, version, length, source, created, rms, covered = struct.unpack_from("<4sIIIqdd", data)
    assert magic == b"PFPR" and length == len(data) and version in (1, 2)
    assert struct.unpack_from("<I", data, length - 4)[0] == crc32c(data[:-4])
    width, height, radial, n = struct.unpack_from("<4I", data, 168)
    names = ("f_u", "f_v", "skew", "c_u", "c_v")
    profile: dict[str, Any] = dict(zip(names, numbers(data, 184, 5), strict=True))
    profile |= dict(zip(("k2", "k3", "k4", "k5"), numbers(data, 240, 4), strict=True))
    names = ("mirror", "pupil_e1", "theta_max", "circle_u", "circle_v", "circle_radius")
    profile |= dict(zip(names, numbers(data, 496, 6), strict=True))
    profile |= {name: numbers(data, at, 3 if name.endswith("theta") else 4) for name, at in ARRAYS.items()}
    profile |= {"tilt": numbers(data, 224, 2), "cpoly": numbers(data, 384, 14)}
    profile |= {"version": version, "source": source, "created": created, "rms_px": rms, "theta_covered": covered}
    profile |= {"name": text(data, 40, 64), "serial": text(data, 104, 64)}
    profile |= {"width": width, "height": height, "radial": radial, "free": list(data[544 : 544 + n])}
    at, k, m = 584, 0, 0
    if version == 2:
        units, held_views, held_rms, views, points = struct.unpack_from("<IIdII", data, 584)
        assert units == 1
        profile |= {"held_out_views": held_views, "held_out_rms_px": held_rms, "views": views, "points": points}
        profile |= {"lens": text(data, 608, 64), "tool": text(data, 672, 32), "tool_version": text(data, 704, 32)}
        profile["model_choice"] = text(data, 736, 64)
        (k, m), at = struct.unpack_from("<II", data, 800), 808
    profile["covariance"] = numbers(data, at, n * (n + 1) // 2)
    at += 4 * n * (n + 1)
    profile["vectors"] = [numbers(data, at + 64 * i, 8) for i in range(k)]
    at += 64 * k
    profile["integer_vectors"] = [struct.unpack_from("<7i", data, at + 28 * i) for i in range(m)]
    assert at + 28 * m + 4 == length
    for key in ("rms_px", "held_out_rms_px"):
        if key in profile and profile[key] != profile[key]:
            profile[key] = None
    return profile
