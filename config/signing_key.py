"""The private key that signs releases, commissioning records and back-ups."""

import base64
import json
import os
import stat
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
    load_pem_private_key,
)

from config.files import read_whole, write_whole
from config.signing import Purpose, SigningError, TrustedKeys, _signed, key_number

KEY_VARIABLE = "TOOLPOINT_SIGNING_KEY"
"""Environment variable that names the file of the private key."""


def private_key_path() -> Path:
    """Return where this account keeps its private key."""
    named = os.environ.get(KEY_VARIABLE)
    return Path(named) if named else Path("~/.config/toolpoint/signing-key.pem").expanduser()


class SigningKey:
    """A person's private key, in the memory of a command of that person."""

    def __init__(self, key: Ed25519PrivateKey) -> None:
        self._key = key

    @classmethod
    def make(cls, path: Path) -> "SigningKey":
        """Make a key and keep it for this account alone; raises SigningError where there is one already."""
        if path.exists():
            raise SigningError(f"{path} exists already and is left as it is")
        key = Ed25519PrivateKey.generate()
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_whole(path, key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()), 0o600)
        return cls(key)

    @classmethod
    def load(cls, path: Path) -> "SigningKey":
        """Read a key that not everybody may read; raises SigningError.

        The group may: systemd gives a service its credentials by an access list, which shows as the group's.
        """
        try:
            content, mode = read_whole(path), stat.S_IMODE(path.stat().st_mode)
        except OSError as error:
            raise SigningError(
                f"{path}: this account has no key to sign with ({error.strerror}); `toolpoint keys make` makes one"
            ) from error
        if mode & (stat.S_IWGRP | stat.S_IRWXO):
            raise SigningError(f"{path} is open to other users (mode {mode:o}); run: chmod 600 {path}")
        try:
            key = load_pem_private_key(content, None)
        except (ValueError, TypeError) as error:
            raise SigningError(f"{path}: this is no private key in PEM form") from error
        if not isinstance(key, Ed25519PrivateKey):
            raise SigningError(f"{path}: this is no Ed25519 key; `toolpoint keys make` makes one")
        return cls(key)

    @classmethod
    def of_this_account(cls, trusted: TrustedKeys, purpose: Purpose) -> "SigningKey | None":
        """Return the key to sign with; None where no signature is asked for and this account has no key.

        Raises SigningError where a signature is asked for that this account cannot give.
        """
        keys = trusted.of(purpose)
        try:
            path = private_key_path()
            there = path.exists()
        except (OSError, RuntimeError) as error:  # an account without a home, or with that of another one
            if keys:
                raise SigningError(
                    f"this account has no place for a key to sign with ({error}); set {KEY_VARIABLE}"
                ) from error
            return None
        if not keys and not there:
            return None
        key = cls.load(path)
        if keys and key.number not in keys:
            raise SigningError(
                f"the key in {path} ({key.number}) does not count here: {trusted.folder} does not hold it for a "
                f"{purpose}"
            )
        return key

    @property
    def number(self) -> str:
        return key_number(self._key.public_key())

    @property
    def public(self) -> bytes:
        return self._key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)

    def signature(self, purpose: Purpose, content: bytes) -> bytes:
        raw = self._key.sign(_signed(purpose, content))
        told = {"key": self.number, "signature": base64.b64encode(raw).decode()}
        return json.dumps(told).encode() + b"\n"
