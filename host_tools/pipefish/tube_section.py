"""One cross-section of a tube: its curve, diameters, and how they change with its parameters."""

from __future__ import annotations

import numpy as np

MEASURED = ("ok", "circle_only")  # statuses of stations that have sizes


def section_points(shape: np.ndarray, t: np.ndarray) -> np.ndarray:
    """The curve { M u + g n } of tube/section.hpp: shape (n,k), t (m,) -> (n,m,2)."""
    rho, ec, es = (shape[:, k, None] for k in range(3))
    c, s = np.cos(t), np.sin(t)
    y = np.stack([(rho + ec) * c + es * s, es * c + (rho - ec) * s], -1)
    if shape.shape[1] > 3:
        n = np.stack([(rho - ec) * c - es * s, -es * c + (rho + ec) * s], -1)
        g = sum(
            shape[:, k, None] * np.cos(h * t) + shape[:, k + 1, None] * np.sin(h * t)
            for h, k in zip(range(3, 9), range(3, shape.shape[1], 2), strict=False)
        )
        y = y + g[..., None] * n / np.linalg.norm(n, axis=-1, keepdims=True)
    return y


AROUND = np.arange(360) * np.pi / 180


def size(shape: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Perimeter / pi, and diameter of the circle of equal area, of each section."""
    y = section_points(shape, AROUND)
    following = np.roll(y, -1, axis=1)
    # A polygon of 360 corners: its perimeter is short by 1 / (24 * 57.3^2), its area by four times that.
    chord = np.linalg.norm(following - y, axis=2).sum(1) * (1 + (np.pi / 180) ** 2 / 24)
    area = 0.5 * np.abs((y[..., 0] * following[..., 1] - y[..., 1] * following[..., 0]).sum(1))
    area *= 1 + (np.pi / 180) ** 2 / 6
    return chord / np.pi, 2 * np.sqrt(area / np.pi)


def calipers(shape: np.ndarray) -> dict[str, np.ndarray]:
    """Widest and narrowest caliper width of each section, their direction and the parameters where they touch."""
    # A section's reaches in all directions are half a megabyte: of a long pipe only so many are there at a time.
    parts = [_calipers_of(shape[i : i + 32]) for i in range(0, max(1, len(shape)), 32)]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _calipers_of(shape: np.ndarray) -> dict[str, np.ndarray]:
    direction = np.arange(180) * np.pi / 180
    y = section_points(shape, AROUND)
    reach = y @ np.stack([np.cos(direction), np.sin(direction)])
    width = reach.max(1) - reach.min(1)
    out = {}
    for name, at in (("max", width.argmax(1)), ("min", width.argmin(1))):
        rows = np.arange(len(shape))
        out[name] = width[rows, at]
        out[name + "_direction"] = direction[at]
        out[name + "_touch"] = np.stack([reach[rows, :, at].argmax(1), reach[rows, :, at].argmin(1)], 1)
    return out


def gradients(shape: np.ndarray, touching: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Derivatives (n,k) of the diameters by the section's parameters. A caliper's touching points may be held (they
    are where the width is stationary)."""
    n, k = shape.shape
    out = {name: np.zeros((n, k)) for name in ("d_mean", "d_area", "d_max", "d_min")}
    step = 1e-4 * shape[:, :1]
    for p in range(k):
        up, down = shape.copy(), shape.copy()
        up[:, p : p + 1] += step
        down[:, p : p + 1] -= step
        for name, a, b in zip(("d_mean", "d_area"), size(up), size(down), strict=True):
            out[name][:, p] = (a - b) / (2 * step[:, 0])
        difference = (section_points(up, AROUND) - section_points(down, AROUND)) / (2 * step[..., None])
        rows = np.arange(n)
        for name in ("max", "min"):
            d = touching[name + "_direction"]
            touch = touching[name + "_touch"]
            move = difference[rows, touch[:, 0]] - difference[rows, touch[:, 1]]
            out["d_" + name][:, p] = move[:, 0] * np.cos(d) + move[:, 1] * np.sin(d)
    return out
