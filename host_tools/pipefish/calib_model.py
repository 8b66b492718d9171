"""What a calibration may leave free: the camera's blocks of parameters and the board's shape, as levels."""

from __future__ import annotations

import dataclasses
from typing import Any

from .camera import PARAMETERS
from .errors import ArgumentError

#: Levels of each block, from the least to the most.
RADIAL = (1, 2, 3, 4)  # how many of k2..k5
SHAPE = ("flat", "bend", "z2", "z4", "z6", "z6xy")
PUPIL = ("", "e1")
ASYMMETRY = ("", "cpoly2", "cpoly3", "p23")
CORNER = ("", "saddle")

# Coefficients of engine/calib/shape.hpp: aspect, shear, heights of degree 2 to 6 (3 + 4 + 5 + 6 + 7), in-plane 14.
_SHAPE_TERMS = {
    "flat": (),
    "bend": (2, 4),
    "z2": tuple(range(5)),
    "z4": tuple(range(14)),
    "z6": tuple(range(27)),
    "z6xy": tuple(range(41)),
}
_ASYMMETRY_TERMS = {
    "": (),
    "cpoly2": tuple(range(27, 35)),
    "cpoly3": tuple(range(27, 41)),
    "p23": tuple(range(9, 23)),
}


@dataclasses.dataclass(frozen=True)
class Model:
    """Levels of the blocks. radial: how many of k2..k5; the others: of SHAPE, PUPIL, ASYMMETRY, CORNER (a bias
    of the detector: corners shift where brightness falls off)."""

    radial: int = 4
    shape: str = "flat"
    pupil: str = ""
    asymmetry: str = ""
    corner: str = ""

    @property
    def parameters(self) -> list[int]:
        """Numbers of the camera's free parameters, ascending; unit vectors of p23 whole."""
        free = [0, 1, 3, 4, *range(5, 5 + self.radial), *_ASYMMETRY_TERMS[self.asymmetry]]
        return sorted(free + ([PARAMETERS.index("pupil_e1")] if self.pupil else []))

    @property
    def shape_terms(self) -> list[int]:
        """Numbers of the board's free shape coefficients, ascending."""
        return list(_SHAPE_TERMS[self.shape])

    @property
    def freedom(self) -> tuple[int, int]:
        """Free numbers of the camera (a gauge counts once) and of the board (shape, corners)."""
        camera = len(self.parameters) - (2 if self.asymmetry == "p23" else 0)
        return camera, len(self.shape_terms) + (2 if self.corner else 0)

    @property
    def name(self) -> str:
        """As people read it: p9 + z2 + e1."""
        base = f"p{5 + self.radial}" if self.radial != 1 else "p6"
        parts = ["p23" if self.asymmetry == "p23" and self.radial == 4 else base]
        if self.asymmetry and parts[0] != "p23":
            parts.append(self.asymmetry)
        return " + ".join(
            parts + [p for p in (self.pupil, "" if self.shape == "flat" else self.shape, self.corner) if p]
        )

    def steps(self) -> list[Model]:
        """Models one or two levels up in one block, or in asymmetry any."""
        found: list[Model] = []
        for block, levels in (("radial", RADIAL), ("shape", SHAPE), ("pupil", PUPIL), ("corner", CORNER)):
            at = levels.index(getattr(self, block))  # type: ignore[arg-type]
            found += [dataclasses.replace(self, **{block: level}) for level in levels[at + 1 : at + 3]]
        at = ASYMMETRY.index(self.asymmetry)
        found += [dataclasses.replace(self, asymmetry=level) for level in ASYMMETRY[at + 1 :]]
        return found


def named(model: str, board: str) -> Model | None:
    """The model that a user asks for; None is "auto". Raises ArgumentError."""
    if board not in ("flat", "shape"):
        raise ArgumentError(f"board: must be 'flat' or 'shape', not {board!r:.40}")
    shape = "flat" if board == "flat" else "z2"
    known: dict[str, Any] = {
        "auto": None,
        "p6": Model(1, shape),
        "p9": Model(4, shape),
        "p23": Model(4, shape, "", "p23"),
    }
    if model not in known:
        raise ArgumentError(f"model: must be one of {', '.join(known)}, not {model!r:.40}")
    return known[model]
