"""Reading MCAP records one by one, so that damage has an offset and a torn tail does not hide what stands before it.

The `mcap` package writes survey files and parses each record; its readers, however, give up on a file without a footer
and do not say where a file is damaged. A survey must open whatever happened to the host, so records are walked here.
"""

from __future__ import annotations

import io
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import CRCValidationError, breakup_chunk
from mcap.writer import MCAP0_MAGIC

from pipefish.errors import FormatError

RECORD_HEADER = struct.Struct("<BQ")


@dataclass
class Scanned:
    """One record of the data section: `offset` in the file in bytes, `record` as the mcap package parses it.

    A chunk arrives as its message, schema and channel records, in `chunk`; `record` is then None.
    """

    offset: int
    length: int
    record: Attachment | Metadata | Schema | Channel | Message | None
    chunk: list[Schema | Channel | Message] | None = None


@dataclass
class Damage:
    """What is wrong with a file, and where. `tail`: nothing usable follows (an interrupted write)."""

    offset: int
    reason: str
    tail: bool


def _parse(opcode: int, body: bytes, offset: int) -> Scanned | None:
    """Parses one record body; None for records that a scan does not need. Raises ValueError when it makes no sense."""
    length = RECORD_HEADER.size + len(body)
    stream = ReadDataStream(io.BytesIO(body))
    try:
        match opcode:
            case Opcode.CHUNK:
                return Scanned(offset, length, None, breakup_chunk(Chunk.read(stream), validate_crc=True))
            case Opcode.SCHEMA:
                return Scanned(offset, length, Schema.read(stream))
            case Opcode.CHANNEL:
                return Scanned(offset, length, Channel.read(stream))
            case Opcode.MESSAGE:
                return Scanned(offset, length, Message.read(stream, len(body)))
            case Opcode.ATTACHMENT:
                return Scanned(offset, length, Attachment.read(stream))
            case Opcode.METADATA:
                return Scanned(offset, length, Metadata.read(stream))
            case _:
                return None
    except CRCValidationError as error:
        raise ValueError("checksum wrong") from error
    except (McapError, struct.error, ValueError, EOFError, MemoryError, OverflowError) as error:
        raise ValueError(f"damaged record ({type(error).__name__})") from error
    except Exception as error:  # zstd and lz4 raise their own kinds on garbage
        raise ValueError(f"damaged record ({type(error).__name__}: {error})") from error


class McapScan:
    """Walks the data section of an MCAP file.

    Attributes after iteration:
        damage    list of Damage met; a complete file has none
        complete  whether the data section ended properly (DataEnd record seen)
        end       offset after the last whole record of the data section
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.damage: list[Damage] = []
        self.complete = False
        self.end = 0

    def __iter__(self) -> Iterator[Scanned]:
        """Yields the whole records. Raises FormatError if the file is not MCAP at all."""
        with open(self.path, "rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            magic = stream.read(len(MCAP0_MAGIC))
            if magic != MCAP0_MAGIC:
                if magic == MCAP0_MAGIC[: len(magic)]:  # cut within the first eight bytes
                    self.damage.append(Damage(len(magic), "the file ends before its first record", tail=True))
                    return
                raise FormatError(self.path, "offset 0", "not an MCAP file (wrong magic)")
            yield from self._records(stream, size)

    def _records(self, stream: BinaryIO, size: int) -> Iterator[Scanned]:
        known = {int(code) for code in Opcode}
        while True:
            offset = self.end = stream.tell()
            head = stream.read(RECORD_HEADER.size)
            if len(head) < RECORD_HEADER.size:
                self.damage.append(Damage(offset, "the file ends within a record", tail=True))
                return
            opcode, length = RECORD_HEADER.unpack(head)
            if opcode == Opcode.DATA_END:
                self.complete = True
                return
            if opcode == 0 or (opcode < 0x80 and opcode not in known):
                self.damage.append(Damage(offset, f"unknown record type 0x{opcode:02x}", tail=True))
                return
            if length > size - stream.tell():
                self.damage.append(Damage(offset, "the file ends within a record", tail=True))
                return
            try:
                scanned = _parse(opcode, stream.read(length), offset)
            except ValueError as error:
                self.damage.append(Damage(offset, str(error), tail=stream.tell() == size))
                continue
            if scanned is not None:
                yield scanned


def read_chunk(path: Path, offset: int) -> list[Schema | Channel | Message]:
    """The records of the chunk at `offset`, from an earlier scan. Raises FormatError if it is gone or damaged."""
    with open(path, "rb") as stream:
        stream.seek(offset)
        head = stream.read(RECORD_HEADER.size)
        try:
            if len(head) < RECORD_HEADER.size:
                raise ValueError("the file ends within a record")
            opcode, length = RECORD_HEADER.unpack(head)
            scanned = _parse(opcode, stream.read(length), offset)
        except ValueError as error:
            raise FormatError(path, f"offset {offset}", str(error)) from error
    if scanned is None or scanned.chunk is None:
        raise FormatError(path, f"offset {offset}", "no chunk here; was the file changed since it was opened?")
    return scanned.chunk
