"""Signatures of what people answer for: release records, commissioning records, back-ups.

Ed25519 over a purpose and a file's bytes, beside the file as `NAME.sig`. Where the folder of public keys, which the
daemon can read and not write, holds keys, what none of them has signed is refused; else nothing is checked.
"""

import base64
import binascii
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import load_pem_public_key

from config.files import read_whole
from models.errors import RefusedInputError

Purpose = Literal["release record", "commissioning record", "back-up"]
LIMITS: Mapping[str, Purpose] = {
    "release": "release record",
    "commissioning": "commissioning record",
    "back-up": "back-up",
}
"""What the name of a key's file limits it to: what it is for."""
PUBLIC_SUFFIX = ".pub"
SIGNATURE_SUFFIX = ".sig"


class SigningError(RefusedInputError):
    """A key or a signature is refused; the text says why and what to do."""


def signature_beside(path: Path) -> Path:
    return path.with_name(f"{path.name}{SIGNATURE_SUFFIX}")


def signature_of(path: Path) -> bytes | None:
    """Return the signature beside a file, None where there is none; raises OSError."""
    try:
        return read_whole(signature_beside(path))
    except FileNotFoundError:
        return None


@dataclass(frozen=True, slots=True, kw_only=True)
class TrustedKey:
    """One public key that counts."""

    name: str
    """Whose it is: the name of its file up to the first dot."""
    purposes: tuple[Purpose, ...]
    key: Ed25519PublicKey


@dataclass(frozen=True, slots=True)
class TrustedKeys:
    """The public keys that count on this machine: `anna.pub` for everything, `night.release.pub` for releases alone."""

    folder: Path
    keys: Mapping[str, TrustedKey]
    """Number of the key: the key."""

    @classmethod
    def read(cls, folder: Path) -> "TrustedKeys":
        """Return the keys in a folder, none where it is not there; raises SigningError for what is no key."""
        try:
            paths = sorted(path for path in folder.iterdir() if path.suffix == PUBLIC_SUFFIX)
        except FileNotFoundError:
            return cls(folder, {})
        except OSError as error:
            raise SigningError(f"{folder}: the keys that count cannot be read ({error.strerror})") from error
        try:  # one that is named and not there, such as a link to a stick that is pulled, is no lesser key
            found = [trusted_key(path, read_whole(path)) for path in paths]
        except OSError as error:
            raise SigningError(f"{error.filename}: this key that counts cannot be read ({error.strerror})") from error
        return cls(folder, {key_number(trusted.key): trusted for trusted in found})

    def of(self, purpose: Purpose) -> dict[str, TrustedKey]:
        return {number: key for number, key in self.keys.items() if purpose in key.purposes}

    def signer(self, purpose: Purpose, content: bytes, signature: bytes | None, what: str) -> str:
        """Return whose key has signed this content, '' where no key counts; raises SigningError for all else."""
        if not (keys := self.of(purpose)):
            return ""
        if signature is None:
            raise SigningError(
                f"{what} is not signed, and {self.folder} names who must: look at it, then `toolpoint keys sign`"
            )

        try:
            told = json.loads(signature)
            number, raw = str(told["key"]), base64.b64decode(told["signature"], validate=True)
        except (ValueError, TypeError, KeyError, RecursionError, binascii.Error) as error:
            raise SigningError(f"{what}: its signature cannot be read; it counts for nothing") from error
        if number not in keys:
            raise SigningError(
                f"{what} is signed with the key {number[:16]!a}, which {self.folder} does not hold for a {purpose}"
            )
        try:
            keys[number].key.verify(raw, _signed(purpose, content))
        except InvalidSignature as error:
            raise SigningError(
                f"{what} is not what {keys[number].name} has signed: it was changed afterwards, or the signature is of "
                "something else"
            ) from error
        return keys[number].name


def trusted_key(path: Path, content: bytes) -> TrustedKey:
    """Return the key that a file of this name and content is; raises SigningError."""
    name, *limits = path.stem.split(".")
    if unknown := [limit for limit in limits if limit not in LIMITS]:
        raise SigningError(f"{path}: a key is limited to {', '.join(LIMITS)}, not to {unknown[0]!a}; rename it")
    purposes = tuple(LIMITS[limit] for limit in limits) or tuple(LIMITS.values())
    return TrustedKey(name=name, purposes=purposes, key=public_key(content, str(path)))


def _signed(purpose: Purpose, content: bytes) -> bytes:
    """Return the bytes that are signed: a signature for one purpose is none for another."""
    return f"toolpoint {purpose} 1\n".encode() + content


def key_number(key: Ed25519PublicKey) -> str:
    return hashlib.sha256(key.public_bytes_raw()).hexdigest()[:16]


def public_key(content: bytes, source: str) -> Ed25519PublicKey:
    """Return the public key that a file holds; raises SigningError."""
    try:
        key = load_pem_public_key(content)
    except ValueError as error:
        raise SigningError(f"{source}: this is no public key in PEM form") from error
    if not isinstance(key, Ed25519PublicKey):
        raise SigningError(f"{source}: this is no Ed25519 key; `toolpoint keys make` makes one")
    return key


# --- the private key -------------------------------------------------------------------------
