"""Camera profiles on a device: send one, confirm it, go back to the one before."""

from __future__ import annotations

import hashlib
import time

from pipefish import pipefish_pb2 as pb
from pipefish.client import BUSY, LOOKING, Client, Handlers, NoDevice
from pipefish.errors import PipefishError
from pipefish.terminal import in_line

KIND_PROFILE = 4  # pf_object_kind
SEND_S = 60.0  # longest time for the 8 kB of a profile: six times what 9600 baud take


class _Delivery(Handlers):
    """What became of the profile that was sent."""

    def __init__(self) -> None:
        self.stored: bool | None = None

    def on_sent(self, name: bytes) -> None:
        self.stored = True

    def on_refused(self, name: bytes) -> None:
        self.stored = False


class Flasher:
    """Talks to one device about its profiles. Raises PipefishError with the device's words where it refuses."""

    def __init__(self, transport: object, timeout_s: float) -> None:
        """`timeout_s`: how long a silent device is waited for; 0 = for ever."""
        self._delivery = _Delivery()
        self._client = Client(transport, self._delivery)
        self._timeout_s = timeout_s

    def __enter__(self) -> Flasher:
        self._client.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._client.close()

    def state(self) -> pb.ProfileState:
        """What the device uses and what it has stored."""
        return self._client.answer_to(self._timeout_s, get_profile=pb.Nothing()).profile

    def send(self, data: bytes) -> pb.ProfileState:
        """Sends a profile in its binary form; it is stored when this returns, on trial. The device has read it back and
        tested itself with it. A connection that breaks, and a device that restarts, are waited for."""
        self.state()  # a device that keeps no profiles says so
        if self._client.answer_to(self._timeout_s, get_status=pb.Nothing()).status.looking_on == BUSY:
            raise PipefishError(f"the device refuses the profile: {LOOKING[BUSY]}")
        name = hashlib.sha256(data).digest()
        self._delivery.stored = None
        self._client.link.send_object(name, KIND_PROFILE, data)
        end = time.monotonic() + max(SEND_S, self._timeout_s)
        self._client.run(lambda: self._delivery.stored is not None or time.monotonic() > end, self._timeout_s)
        if self._delivery.stored is None:
            raise NoDevice(f"the device on {self._client.transport.name} did not take the profile")
        state = self.state()
        if not self._delivery.stored:
            raise PipefishError(f"the device refuses the profile: {in_line(state.problem) or 'it does not say why'}")
        if state.stored.sha256 != name:
            raise PipefishError("the device has stored another profile than the one that was sent")
        return state

    def confirm(self, sha256: bytes) -> pb.ProfileState:
        """Ends the trial of the stored profile, which must be the one with this SHA-256."""
        return self._client.answer_to(self._timeout_s, confirm_profile=sha256).profile

    def revert(self) -> pb.ProfileState:
        """Drops the profile on trial; without one, goes back to the one before."""
        return self._client.answer_to(self._timeout_s, revert_profile=pb.Nothing()).profile
