"""Certificates of servers: what accepts one that is vouched for, and why one is not accepted."""

import ssl
from pathlib import Path

from config.files import read_whole
from config.secret_files import SecretError


def tls_context(ca_certificate: Path | None) -> ssl.SSLContext:
    """Return what accepts a server whose certificate is vouched for; raises SecretError."""
    try:
        if ca_certificate is not None:
            read_whole(ca_certificate)  # of a pipe OpenSSL would wait for an end
        context = ssl.create_default_context(cafile=None if ca_certificate is None else str(ca_certificate))
        context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN  # by the authority that signed it, though below another
        return context
    except (OSError, ssl.SSLError) as error:
        raise SecretError(
            f"`ca_certificate` {ca_certificate} cannot be read ({error}): name a certificate in PEM"
        ) from error


def unvouched(error: ssl.SSLCertVerificationError, key: str) -> str:
    """Return why a certificate is not accepted, and what to do; `key` of the configuration holds the server's name."""
    why = error.verify_message.rstrip(".")
    if "mismatch" in why:
        return f"{why}: `{key}` must be a name in its certificate"
    if "expired" in why or "not yet" in why:
        return f"{why}: renew it on the server, or set the clock that is wrong"
    return f"{why}: its certificate is none that `ca_certificate` vouches for, or it leaves out an authority between"
