"""This host's key and the devices that it knows: who is at the other end of a network (docs/network.md).

A key is named by the SHA-256 of its public half (SubjectPublicKeyInfo, DER) in 64 hexadecimal digits. Certificates only
carry keys; their dates and issuers mean nothing."""

from __future__ import annotations

import contextlib
import datetime
import fcntl
import hashlib
import os
import re
import socket
from collections.abc import Iterator
from pathlib import Path

from pipefish.errors import PipefishError
from pipefish.files import write_atomically

ROLES = ("viewer", "operator", "calibrator")


def key_folder() -> Path:
    """Where this user's key and devices are: $XDG_CONFIG_HOME/pipefish or ~/.config/pipefish."""
    home = os.environ.get("XDG_CONFIG_HOME")
    return (Path(home) if home else Path.home() / ".config") / "pipefish"


@contextlib.contextmanager
def _locked() -> Iterator[None]:
    """The folder, made if it is not there, for one program at a time, which reads, changes and writes what is in it.

    Raises PipefishError."""
    folder = key_folder()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as error:
        raise PipefishError(f"{folder}: {error.strerror}") from error
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def parse_key(text: str) -> str:
    """64 hexadecimal digits, in lower case. Raises PipefishError."""
    if not re.fullmatch(r"[0-9a-fA-F]{64}", text):
        raise PipefishError(f"'{text}' is no key: 64 hexadecimal digits, as `pipefish pair` prints")
    return text.lower()


def certificate_key(der: bytes) -> str:
    """The key that a certificate (DER) carries. Raises ValueError: none that can be read."""
    from cryptography import x509
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

    try:
        public = x509.load_der_x509_certificate(der).public_key()
    except (x509.InvalidVersion, UnsupportedAlgorithm) as error:
        raise ValueError(str(error)) from error
    return hashlib.sha256(public.public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)).hexdigest()


def _make_host_key(path: Path) -> None:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
    from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
    from cryptography.x509.oid import NameOID

    key = Ed25519PrivateKey.generate()
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "pipefish host")])
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(datetime.datetime(1970, 1, 1))
        .not_valid_after(datetime.datetime(9999, 12, 31))
        .sign(key, None)
    )
    private = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    draft = path.with_suffix(f".{os.getpid()}")
    with os.fdopen(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as out:
        out.write(private + certificate.public_bytes(Encoding.PEM))
        out.flush()
        os.fsync(out.fileno())
    draft.rename(path)


def host_key_file() -> Path:
    """The PEM file of this host's private key and certificate, made if it is not there. Raises PipefishError."""
    path = key_folder() / "host.pem"
    try:
        if not path.exists():
            with _locked():
                if not path.exists():
                    _make_host_key(path)
        elif path.stat().st_mode & 0o077:
            raise PipefishError(f"{path}: others may read this private key; remove it and pair again, or chmod 600")
    except OSError as error:
        raise PipefishError(f"{path}: {error.strerror}") from error
    return path


def host_key() -> str:
    """This host's key. Raises PipefishError."""
    from cryptography import x509
    from cryptography.hazmat.primitives.serialization import Encoding

    path = host_key_file()
    try:
        return certificate_key(x509.load_pem_x509_certificate(path.read_bytes()).public_bytes(Encoding.DER))
    except ValueError as error:
        raise PipefishError(f"{path}: no certificate in it: remove it and pair again") from error


def host_name() -> str:
    """What this host calls itself when it pairs: USER@HOST in printable ASCII, at most 47 characters."""
    try:
        user = os.environ.get("USER") or Path.home().name
    except RuntimeError:
        user = "host"
    return re.sub(r"[^!-~]", "_", f"{user}@{socket.gethostname()}")[:47]


def known_devices() -> dict[str, str]:
    """Name of each device that this host knows, by key. Raises PipefishError on a damaged file."""
    path = key_folder() / "devices"
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        return {}
    except (OSError, UnicodeDecodeError) as error:
        raise PipefishError(f"{path}: {getattr(error, 'strerror', None) or 'not UTF-8'}") from error
    devices = {}
    for number, line in enumerate(lines, 1):
        if not line or line.startswith("#"):
            continue
        key, _, name = line.partition(" ")
        if not re.fullmatch(r"[0-9a-f]{64}", key) or not name.strip():
            raise PipefishError(f"{path}:{number}: must be a key of 64 hexadecimal digits and a name")
        devices[key] = name.strip()
    return devices


def _write_devices(devices: dict[str, str]) -> None:
    text = "".join(f"{key} {name}\n" for key, name in devices.items())
    try:
        write_atomically(key_folder() / "devices", text.encode())
    except OSError as error:
        raise PipefishError(f"{key_folder() / 'devices'}: {error.strerror}") from error


def remember_device(key: str, name: str) -> list[str]:
    """Adds a device to those known, or gives it another name; returns the keys of others that are called so, too.

    Raises PipefishError."""
    key, name = parse_key(key), name.strip()
    if not name or not name.isprintable():
        raise PipefishError(f"'{name}' is no name for a device")
    with _locked():
        devices = known_devices() | {key: name}
        _write_devices(devices)
    return [k for k, n in devices.items() if n == name and k != key]


def forget_device(key_or_name: str) -> str:
    """Removes a device; returns its name. Raises PipefishError if it is not known, or several have this name."""
    with _locked():
        devices = known_devices()
        keys = [key for key, name in devices.items() if key_or_name in (key, name)]
        if not keys:
            raise PipefishError(f"no device '{key_or_name}' is known here")
        if len(keys) > 1:
            raise PipefishError(f"{len(keys)} devices are called '{key_or_name}': say the key: {', '.join(keys)}")
        name = devices.pop(keys[0])
        _write_devices(devices)
        return name
