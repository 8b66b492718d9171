"""Point clouds in files: PLY (ASCII and binary), XYZ and CSV text, NumPy arrays in; PLY out."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from pipefish.errors import FormatError, file_error

_TYPES = {
    **{name: "i1" for name in ("char", "int8")},
    **{name: "u1" for name in ("uchar", "uint8")},
    **{name: "i2" for name in ("short", "int16")},
    **{name: "u2" for name in ("ushort", "uint16")},
    **{name: "i4" for name in ("int", "int32")},
    **{name: "u4" for name in ("uint", "uint32")},
    **{name: "f4" for name in ("float", "float32")},
    **{name: "f8" for name in ("double", "float64")},
}
_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float"}
_NAMES["f8"] = "double"
READS = (".ply", ".xyz", ".txt", ".csv", ".npy")


def read_points(path: str | os.PathLike[str]) -> tuple[np.ndarray, np.ndarray | None]:
    """Points (N,3) of a file, and their sigmas (N,) where it has a column `sigma`, else None. Units are the file's.

    .ply: vertices with x, y, z; .npy: (N,3) or (N,4), the fourth sigma; .xyz, .txt, .csv: columns x y z [sigma], by
    their names where the first line is a header, in any order. Raises FormatError, OSError."""
    file = Path(path)
    suffix = file.suffix.lower()
    if suffix not in READS:
        raise FormatError(file, None, f"not a kind of point cloud that is read here ({', '.join(READS)})")
    try:
        data = file.read_bytes()
    except OSError as error:
        raise file_error(error, file) from error
    if suffix == ".ply":
        columns = _read_ply(file, data)
    elif suffix == ".npy":
        columns = _read_npy(file)
    else:
        columns = _read_text(file, data)
    points = np.ascontiguousarray(np.column_stack([columns[k] for k in "xyz"]).astype(float))
    sigma = columns.get("sigma")
    return points, None if sigma is None else np.asarray(sigma, float)


def read_columns(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """All properties of a PLY file's vertices, (N,) by name. Raises FormatError, OSError."""
    file = Path(path)
    try:
        return _read_ply(file, file.read_bytes())
    except OSError as error:
        raise file_error(error, file) from error


def _read_npy(file: Path) -> dict[str, np.ndarray]:
    try:
        array = np.load(file, allow_pickle=False)
    except (ValueError, EOFError) as error:
        raise FormatError(file, None, f"not a NumPy array: {error}") from error
    if (
        not isinstance(array, np.ndarray)
        or array.ndim != 2
        or array.shape[1] not in (3, 4)
        or array.dtype.kind not in "fiu"
    ):
        raise FormatError(file, None, "the array is not (N,3) or (N,4) numbers")
    return dict(zip(("x", "y", "z", "sigma"), array.T, strict=False))


def _read_text(file: Path, data: bytes) -> dict[str, np.ndarray]:
    lines = data.decode("utf-8", errors="replace").replace(",", " ").replace(";", " ").splitlines()
    names, rows = ["x", "y", "z"], []
    for number, line in enumerate(lines, 1):
        fields = line.split()
        if not fields or fields[0].startswith(("#", "//")):
            continue
        try:
            row = [float(f) for f in fields]
        except ValueError:
            if rows or not {"x", "y", "z"} <= {f.lower() for f in fields}:
                raise FormatError(file, f"line {number}", f"not numbers: {line[:40]!r}") from None
            names = [f.lower() for f in fields]
            continue
        if len(row) < len(names) or (rows and len(row) != len(rows[0])):
            raise FormatError(file, f"line {number}", f"{len(row)} columns, not {len(rows[0]) if rows else len(names)}")
        rows.append(row)
    if not rows:
        raise FormatError(file, None, "no points")
    return dict(zip(names, np.array(rows).T, strict=False))


def _read_ply(file: Path, data: bytes) -> dict[str, np.ndarray]:
    end = data.find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        raise FormatError(file, None, "not a PLY file: no header")
    body = data.find(b"\n", end) + 1
    form, elements = "", []
    for number, line in enumerate(data[:end].decode("ascii", errors="replace").splitlines(), 1):
        word = line.split()
        try:
            if word[:1] == ["format"]:
                form = word[1]
            elif word[:1] == ["element"]:
                elements.append((word[1], int(word[2]), []))
            elif word[:1] == ["property"]:
                kind = ("list", word[2], word[3]) if word[1] == "list" else (_TYPES[word[1]],)
                elements[-1][2].append((word[-1], kind))
        except (IndexError, KeyError, ValueError):
            raise FormatError(file, f"line {number}", f"not understood: {line[:60]!r}") from None
    if form not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise FormatError(file, "format", f"'{form}' is not ascii, binary_little_endian or binary_big_endian")
    if not elements or elements[0][0] != "vertex":
        raise FormatError(file, "element", "the first element is not 'vertex'")
    _, count, properties = elements[0]
    if any(kind[0] == "list" for _, kind in properties):
        raise FormatError(file, "vertex", "has a list, which is not read here")
    names = [name for name, _ in properties]
    if not {"x", "y", "z"} <= set(names):
        raise FormatError(file, "vertex", "has no x, y, z")
    if form == "ascii":
        values = data[body:].split(maxsplit=count * len(names))[: count * len(names)]
        if len(values) < count * len(names):
            raise FormatError(file, "vertex", f"ends after {len(values) // len(names)} of {count} points")
        try:
            table = np.array(values, float).reshape(count, len(names))
        except ValueError as error:
            raise FormatError(file, "vertex", f"not numbers: {error}") from None
        return dict(zip(names, table.T, strict=True))
    order = "<" if form == "binary_little_endian" else ">"
    row = np.dtype([(name, order + kind[0]) for name, kind in properties])
    if len(data) - body < count * row.itemsize:
        raise FormatError(file, "vertex", f"ends after {(len(data) - body) // row.itemsize} of {count} points")
    table = np.frombuffer(data, row, count, body)
    return {name: table[name] for name in names}


def ply_bytes(
    vertices: dict[str, np.ndarray], faces: np.ndarray | None = None, comments: tuple[str, ...] = ()
) -> bytes:
    """A binary PLY file: vertex properties (N,) by name, in order; faces (M,3) vertex indices."""
    row = np.dtype([(name, "<" + values.dtype.str[1:]) for name, values in vertices.items()])
    count = len(next(iter(vertices.values())))
    table = np.empty(count, row)
    for name, values in vertices.items():
        table[name] = values
    head: list[Any] = ["ply", "format binary_little_endian 1.0", *(f"comment {c}" for c in comments)]
    head += [f"element vertex {count}", *(f"property {_NAMES[row[name].str[-2:]]} {name}" for name in vertices)]
    body = table.tobytes()
    if faces is not None:
        head += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        corners = np.empty(len(faces), np.dtype([("n", "u1"), ("v", "<i4", (3,))]))
        corners["n"], corners["v"] = 3, faces
        body += corners.tobytes()
    return ("\n".join([*head, "end_header", ""])).encode("ascii") + body
