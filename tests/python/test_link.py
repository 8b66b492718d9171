"""The link through its binding: two ends in Python over a channel that loses frames, in virtual time.

The protocol's own tests are in C (tests/unit/test_link*.c); these prove that the binding passes everything through:
bytes, times, events with their copies, objects kept alive, errors."""

from __future__ import annotations

import gc
import hashlib
import random

import pytest
from pipefish._engine import Link, cobs_decode, cobs_encode, crc32c

DEVICE, HOST = 1, 2
UP, DOWN, INCOMPATIBLE, CONTROL, LATEST, OFFER, OBJECT, SENT, REFUSED = range(1, 10)
ACCEPT, STORED, REFUSE, AGAIN = range(1, 5)
MS = 1_000_000


class Pair:
    """A device and a host, joined by a channel of 1 ms latency that loses `loss` of all frames."""

    def __init__(self, loss: float = 0.0, seed: int = 1) -> None:
        self.now = 10_000 * MS
        self.random = random.Random(seed)
        self.loss = loss
        self.device = Link(role=DEVICE, nonce=11, boot_id=2**63 + 5, schema=3)
        self.host = Link(role=HOST, nonce=22, schema=3, max_object=200_000)
        self.events: dict[Link, list] = {self.device: [], self.host: []}

    def carry(self, source: Link, sink: Link) -> int:
        """Moves what `source` has to say, frame by frame. Returns the number of bytes."""
        data = source.output(8192, self.now)
        for frame in data.split(b"\0")[:-1]:
            if self.random.random() >= self.loss:
                self.events[sink] += sink.input(frame + b"\0", self.now + MS)
        return len(data)

    def turn(self) -> None:
        """Both ends speak once, then 2 ms pass."""
        self.carry(self.device, self.host)
        self.carry(self.host, self.device)
        for link in (self.device, self.host):
            self.events[link] += link.input(b"", self.now)
        self.now += 2 * MS

    def take(self, link: Link) -> list:
        """The events of one end since the last call."""
        events, self.events[link] = self.events[link], []
        return events


def test_hello_carries_who_the_peer_is() -> None:
    pair = Pair()
    for _ in range(3):
        pair.turn()
    (up,) = pair.take(pair.host)
    assert (up.type, up.peer_role, up.peer_version, up.peer_schema, up.peer_nonce) == (UP, DEVICE, 1, 3, 11)
    assert up.peer_boot_id == 2**63 + 5
    assert not up.peer_restarted
    assert repr(up) == "<Event UP, 0 bytes>"
    assert pair.device.is_up and pair.host.is_up
    assert pair.now < pair.host.deadline(pair.now) < pair.now + 1100 * MS


def test_objects_control_and_latest_over_a_channel_that_loses_a_fifth() -> None:
    pair = Pair(loss=0.2)
    spool = {}
    for i in range(10):
        data = bytes(pair.random.randbytes(500 + 9000 * i))
        spool[hashlib.sha256(data).digest()] = data
    waiting = dict(spool)
    stored: dict[bytes, bytes] = {}
    messages, newest, sent = [], [], set()
    said = 0
    for turn in range(20_000):
        while waiting and pair.device.free_send_slots():
            name = next(iter(waiting))
            pair.device.send_object(name, 2, waiting.pop(name))
        if pair.device.is_up and said < 50:
            pair.device.send_latest(1, b"%d" % turn)
            try:
                pair.device.send_control(b"%d" % said)
                said += 1
            except BufferError:
                pass
        pair.turn()
        for event in pair.take(pair.host):
            if event.type == OFFER:
                pair.host.answer_object(event.slot, STORED if event.name in stored else ACCEPT)
            elif event.type == OBJECT:
                assert event.name not in stored
                assert hashlib.sha256(event.data).digest() == event.name
                assert (event.kind, event.size) == (2, len(event.data))
                stored[event.name] = event.data
                pair.host.answer_object(event.slot, STORED)
            elif event.type == CONTROL:
                messages.append(int(event.data))
            elif event.type == LATEST:
                assert event.topic == 1
                newest.append(int(event.data))
        sent |= {event.name for event in pair.take(pair.device) if event.type == SENT}
        if len(sent) == len(spool) and len(messages) == 50:
            break
    assert stored == spool
    assert sent == set(spool)
    assert messages == list(range(50))
    assert newest == sorted(set(newest))
    assert newest
    stats = pair.device.stats
    assert stats["objects_sent"] == 10 and stats["fragments_resent"] > 0
    assert stats["object_bytes_sent"] == sum(map(len, spool.values()))
    assert 0 < stats["rtt_us"] < 20_000
    assert abs(stats["peer_clock_offset_ns"]) <= stats["peer_clock_error_ns"] <= 5 * MS


def test_object_resumes_after_a_reset_and_bytes_outlive_their_owner() -> None:
    pair = Pair()
    data = bytes(range(256)) * 600
    name = hashlib.sha256(data).digest()
    pair.device.send_object(name, 2, data + b"")
    expected, data = hashlib.sha256(data).digest(), b""
    gc.collect()
    for turn in range(400):
        if turn == 12:
            pair.device.reset(pair.now)
            pair.host.reset(pair.now)
        pair.turn()
        for event in pair.take(pair.host):
            if event.type == OFFER:
                pair.host.answer_object(event.slot, ACCEPT)
            elif event.type == OBJECT:
                assert hashlib.sha256(event.data).digest() == expected
                pair.host.answer_object(event.slot, STORED)
    types = [event.type for event in pair.take(pair.device)]
    assert types == [UP, DOWN, UP, SENT]
    assert pair.device.stats["fragments_sent"] == 150
    assert pair.device.free_send_slots() == 4


def test_refused_and_cancelled_objects() -> None:
    pair = Pair()
    pair.device.send_object(b"r" * 32, 5, b"x" * 3000)
    pair.device.send_object(b"c" * 32, 5, b"x" * 3000)
    for _ in range(10):
        pair.turn()
        for event in pair.take(pair.host):
            if event.type == OFFER and event.name == b"r" * 32:
                pair.host.answer_object(event.slot, REFUSE)
    pair.device.cancel_object(b"c" * 32)
    for _ in range(10):
        pair.turn()
    assert [(e.type, e.name) for e in pair.take(pair.device) if e.type != UP] == [(REFUSED, b"r" * 32)]
    assert pair.device.free_send_slots() == 4


def test_errors_are_exceptions_with_a_sentence() -> None:
    link = Link(role=HOST, nonce=1)
    with pytest.raises(ValueError, match="out of range"):
        Link(role=7, nonce=1)
    with pytest.raises(ConnectionError, match="no peer"):
        link.send_control(b"x")
    with pytest.raises(ValueError, match="1072"):
        link.output(100, 0)
    with pytest.raises(ValueError, match="32 bytes"):
        link.send_object(b"short", 1, b"x")
    with pytest.raises(ValueError, match="empty"):
        link.send_object(b"n" * 32, 1, b"")
    with pytest.raises(ValueError, match="under way"):
        link.cancel_object(b"n" * 32)
    with pytest.raises(ValueError, match="question"):
        link.answer_object(0, ACCEPT)
    for i in range(4):
        link.send_object(bytes([i]) * 32, 1, b"x")
    with pytest.raises(BufferError):
        link.send_object(b"n" * 32, 1, b"x")


def test_cobs_and_checksum() -> None:
    rng = random.Random(5)
    for n in (0, 1, 253, 254, 255, 508, 509, 1000):
        for data in (rng.randbytes(n), bytes(n), b"\xff" * n):
            code = cobs_encode(data)
            assert 0 not in code
            assert len(code) <= n + n // 254 + 1
            assert cobs_decode(code) == data
    with pytest.raises(ValueError, match="COBS"):
        cobs_decode(b"\x05\x01")
    assert crc32c(b"123456789") == 0xE3069283
    assert crc32c(b"6789", crc32c(b"12345")) == 0xE3069283
