"""Protocol Buffers as plain values: what --json prints of a device's messages."""

from __future__ import annotations

from typing import Any

from google.protobuf.message import Message


def document_of(message: Message) -> dict[str, Any]:
    """All fields that the message has, by name; numbers as numbers, bytes and boot ids in hexadecimal digits as
    everywhere else (Protocol Buffers' own JSON has 64-bit numbers as texts and bytes in base64)."""
    out: dict[str, Any] = {}
    for field in message.DESCRIPTOR.fields:
        value = getattr(message, field.name)
        if field.label == field.LABEL_REPEATED:
            out[field.name] = [_value(field.name, v) for v in value]
        elif not field.has_presence or message.HasField(field.name):
            out[field.name] = _value(field.name, value)
    return out


def _value(name: str, value: Any) -> Any:
    if isinstance(value, Message):
        return document_of(value)
    if isinstance(value, bytes):
        return value.hex()
    return f"{value:016x}" if name == "boot_id" else value
