"""The tracker's parts through ctypes (track_entry.c), for a Python with nothing but numpy and OpenCV."""

import ctypes
from pathlib import Path

import numpy as np

LIBRARY = Path(__file__).resolve().parents[2] / "build/release/tests/bench/libtrack_entry.so"
NEW, TRACKED, LOST = 1, 2, 3


class Entry:
    """A pair of pyramids, an aligner and a tracker for images of one size."""

    def __init__(self, width: int, height: int, max_tracks: int, cell: int = 0, noise: float = 2.0) -> None:
        if not LIBRARY.exists():
            raise SystemExit(f"{LIBRARY} is missing: `make build` makes it")
        lib = ctypes.CDLL(str(LIBRARY))
        lib.entry_new.restype = ctypes.c_void_p
        lib.entry_memory.restype = ctypes.c_size_t
        handle = lib.entry_new(width, height, max_tracks, cell, 0, round(noise * 256))
        if not handle:
            raise SystemExit("the tracker refuses this configuration")
        self.lib, self.handle, self.shape, self.room = lib, ctypes.c_void_p(handle), (height, width), 2 * max_tracks

    def __del__(self) -> None:
        if hasattr(self, "handle"):
            self.lib.entry_free(self.handle)

    def _pixels(self, image: np.ndarray) -> ctypes.c_void_p:
        if image.dtype != np.uint8 or image.shape != self.shape or not image.flags.c_contiguous:
            raise ValueError(f"an image of {self.shape} uint8 in one piece is wanted, not {image.shape} {image.dtype}")
        return image.ctypes.data_as(ctypes.c_void_p)

    def scene(self, zoom: float, seed: int) -> np.ndarray:
        """A picture of the benchmark's texture: (H, W) uint8."""
        out = np.empty(self.shape, np.uint8)
        self.lib.entry_scene(self._pixels(out), self.shape[1], self.shape[0], ctypes.c_double(zoom), seed)
        return out

    def pyramid(self, which: int, image: np.ndarray) -> None:
        """Builds pyramid 0 or 1; `image` must stay."""
        self.lib.entry_pyramid(self.handle, which, self._pixels(image))

    def klt(self, points: np.ndarray, affine: bool, guess: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """(N, 2) points of pyramid 0 -> where they are in pyramid 1, and (N,) whether they settled.

        `guess` (N, 2) is where to begin; without one, where they were."""
        points = np.ascontiguousarray(points, np.float32)
        guess = points if guess is None else np.ascontiguousarray(guess, np.float32)
        to, ok = np.empty_like(points), np.empty(len(points), np.uint8)
        void = ctypes.c_void_p
        self.lib.entry_klt(
            self.handle, points.ctypes.data_as(void), guess.ctypes.data_as(void), len(points), int(affine),
            to.ctypes.data_as(void), ok.ctypes.data_as(void),
        )  # fmt: skip
        return to, ok.astype(bool)

    def reset(self) -> None:
        """Forgets all tracks."""
        self.lib.entry_reset(self.handle)

    def frame(self, image: np.ndarray) -> int:
        """One frame of the tracker; `image` must stay until the next one. Returns the live tracks."""
        return self.lib.entry_frame(self.handle, self._pixels(image))

    def tracks(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The table: id (N,), position (N, 2), covariance (N, 2, 2) px^2, status (N,)."""
        identity, xy = np.empty(self.room, np.uint64), np.empty((self.room, 2), np.float32)
        cov, status = np.empty((self.room, 3), np.float32), np.empty(self.room, np.uint8)
        arrays = [a.ctypes.data_as(ctypes.c_void_p) for a in (identity, xy, cov, status)]
        n = self.lib.entry_tracks(self.handle, *arrays, self.room)
        full = cov[:n][:, [0, 1, 1, 2]].reshape(-1, 2, 2)
        return identity[:n].astype(np.int64), xy[:n].astype(float), full.astype(float), status[:n]

    def memory(self, width: int, height: int, tracks: int, step: int) -> int:
        """Bytes that tracking keeps: tracker, prediction, keyframes, camera with rays at this step; no frames."""
        return self.lib.entry_memory(width, height, tracks, step)
