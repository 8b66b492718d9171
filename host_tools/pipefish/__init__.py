"""Pipefish: measure pipes with one fisheye camera."""

from .camera import Camera

__all__ = ["Camera"]
