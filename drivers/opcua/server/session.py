"""Who is at the other end: the session of a connection, bound to a channel and to a person."""

import contextlib
import hmac
import math
import secrets
import struct
import uuid
from typing import Any
from urllib.parse import urlsplit

from asyncua import ua
from asyncua.crypto import uacrypto
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from asyncua.ua.status_codes import StatusCodes
from asyncua.ua.ua_binary import struct_to_binary

from drivers.opcua.certificates import application_uri
from drivers.opcua.server.requests import Request, ServiceError
from drivers.opcua.server.settings import Identity, LoginRefusedError, Users
from drivers.opcua.server.wire import LONGEST_MESSAGE, NONCE, Wire

LEAST_SESSION_S, MOST_SESSION_S = 10.0, 3600.0
USER_POLICY = "user"
TRANSPORT = "http://opcfoundation.org/UA-Profile/Transport/uatcp-uasc-uabinary"
LONGEST_ADDRESS = 200
TYPES: Any = ua
CRYPTO: Any = uacrypto
"""The library's, whose own types say less than it does."""


class Session:
    """One session: created, then activated by a person who logs in; it ends with its connection."""

    def __init__(self, wire: Wire, identity: Identity, users: Users, product: str, address: str) -> None:
        """`address` is where the client is."""
        self._wire, self._identity, self._users, self._product = wire, identity, users, product
        self._address = address
        self._token: Any = None
        self._nonce = b""
        self.idle_s = LEAST_SESSION_S
        """It ends when nothing is asked for this long [s]."""
        self.person: Any = None

    def description(self, asked: str | None) -> ua.ApplicationDescription:
        """Return what the server is; at the address under which the client asked for it."""
        return ua.ApplicationDescription(
            ApplicationUri=self._identity.application_uri,
            ProductUri=self._identity.application_uri,
            ApplicationName=ua.LocalizedText(self._product),
            ApplicationType=ua.ApplicationType.Server,
            DiscoveryUrls=[_address(asked)],
        )

    def endpoints(self, asked: str | None) -> list[ua.EndpointDescription]:
        """Return where and how the server is reached: signed, or signed and encrypted; by name and password."""
        token = ua.UserTokenPolicy(
            PolicyId=USER_POLICY,
            TokenType=ua.UserTokenType.UserName,
            SecurityPolicyUri=SecurityPolicyBasic256Sha256.URI,
        )
        return [
            ua.EndpointDescription(
                EndpointUrl=_address(asked),
                Server=self.description(asked),
                ServerCertificate=self._identity.der,
                SecurityMode=mode,
                SecurityPolicyUri=SecurityPolicyBasic256Sha256.URI,
                UserIdentityTokens=[token],
                TransportProfileUri=TRANSPORT,
                SecurityLevel=ua.Byte(level),
            )
            for mode, level in ((ua.MessageSecurityMode.SignAndEncrypt, 100), (ua.MessageSecurityMode.Sign, 50))
        ]

    def create(self, request: Request) -> bytes:
        """Answer CreateSession; raises ServiceError."""
        if not self._wire.secured:
            raise ServiceError(StatusCodes.BadSecurityModeInsufficient)
        if self.person is not None:
            raise ServiceError(
                StatusCodes.BadTooManySessions
            )  # on this connection; one that nobody activated is given up
        wanted = request.structure(ua.CreateSessionParameters)
        sent = self._wire.policy.peer_certificate  # its own; those of its authorities may follow (OPC 10000-4, 5.6.2)
        if not (wanted.ClientCertificate or b"").startswith(sent):
            raise ServiceError(StatusCodes.BadCertificateInvalid)
        if wanted.ClientDescription.ApplicationUri != application_uri(self._wire.peer):
            raise ServiceError(StatusCodes.BadCertificateUriInvalid)
        if len(wanted.ClientNonce or b"") < NONCE:
            raise ServiceError(StatusCodes.BadNonceInvalid)
        self._token, self._nonce = TYPES.NodeId(uuid.uuid4(), 0, ua.NodeIdType.Guid), secrets.token_bytes(NONCE)
        self._wire.most_bytes = min(self._wire.most_bytes, wanted.MaxResponseMessageSize or math.inf)
        asked_s = float(wanted.RequestedSessionTimeout) / 1000.0
        self.idle_s = min(max(asked_s, LEAST_SESSION_S), MOST_SESSION_S) if math.isfinite(asked_s) else MOST_SESSION_S
        signature = self._wire.policy.asymmetric_cryptography.signature(sent + wanted.ClientNonce)
        made = ua.CreateSessionResult(
            SessionId=TYPES.NodeId(uuid.uuid4(), 1, ua.NodeIdType.Guid),
            AuthenticationToken=self._token,
            RevisedSessionTimeout=ua.Double(self.idle_s * 1000.0),
            ServerNonce=self._nonce,
            ServerCertificate=self._identity.der,
            ServerEndpoints=self.endpoints(wanted.EndpointUrl),
            ServerSignature=ua.SignatureData(SecurityPolicyBasic256Sha256.AsymmetricSignatureURI, signature),
            MaxRequestMessageSize=ua.UInt32(LONGEST_MESSAGE),
        )
        encoded: bytes = struct_to_binary(made)
        return encoded

    async def activate(self, request: Request) -> bytes:
        """Answer ActivateSession: check signature, name and password; raises ServiceError."""
        if self._token is None or not self._wire.secured:
            raise ServiceError(StatusCodes.BadSessionIdInvalid)
        self.check_token(request)
        wanted = request.structure(ua.ActivateSessionParameters)
        nonce, self._nonce = self._nonce, secrets.token_bytes(NONCE)
        try:
            signed = self._identity.der + nonce
            self._wire.policy.asymmetric_cryptography.verify(signed, wanted.ClientSignature.Signature or b"")
        except Exception as error:
            raise ServiceError(StatusCodes.BadApplicationSignatureInvalid) from error
        name, password = self._named(wanted.UserIdentityToken, nonce)
        try:
            person = await self._users.login(name, password, self._address)
        except LoginRefusedError as error:
            raise ServiceError(StatusCodes.BadUserAccessDenied) from error
        self.left()
        self.person = person
        return struct.pack("<i", NONCE) + self._nonce + b"\xff\xff\xff\xff" * 2

    def _named(self, token: Any, nonce: bytes) -> tuple[str, str]:
        """Return name and password; raises ServiceError for any other way of saying who one is."""
        if not isinstance(token, ua.UserNameIdentityToken):
            raise ServiceError(StatusCodes.BadIdentityTokenRejected)
        if token.EncryptionAlgorithm != SecurityPolicyBasic256Sha256.AsymmetricEncryptionURI:
            raise ServiceError(StatusCodes.BadIdentityTokenInvalid)
        try:
            plain = CRYPTO.decrypt_rsa_oaep(self._identity.private_key, token.Password)
            (length,) = struct.unpack_from("<I", plain)
            secret, given = plain[4 : 4 + length - NONCE], plain[4 + length - NONCE : 4 + length]
            if not hmac.compare_digest(given, nonce):
                raise ServiceError(StatusCodes.BadIdentityTokenInvalid)
            return str(token.UserName or ""), secret.decode("utf-8")
        except (ValueError, TypeError, struct.error) as error:
            raise ServiceError(StatusCodes.BadIdentityTokenInvalid) from error

    def check(self, request: Request) -> Any:
        """Return who asks; raises ServiceError when nobody is logged in, or the account is no longer what it was."""
        self.check_token(request)
        if self.person is None:
            raise ServiceError(StatusCodes.BadSessionNotActivated)
        self.person = self._users.present(self.person)
        if self.person is None:
            raise ServiceError(StatusCodes.BadSessionClosed)
        return self.person

    def check_token(self, request: Request) -> None:
        if self._token is None or request.token != self._token.Identifier:
            raise ServiceError(StatusCodes.BadSessionIdInvalid)

    def left(self) -> None:
        """Note that nobody is logged in any more."""
        if self.person is not None:
            self._users.left(self.person)
            self.person = None


def _address(asked: str | None) -> str:
    """Return the address under which a client asks, so that it finds the server behind another name too."""
    if asked and len(asked) <= LONGEST_ADDRESS and asked.isascii() and asked.isprintable():
        with contextlib.suppress(ValueError):  # of half an IPv6 address
            parts = urlsplit(asked)
            if parts.scheme == "opc.tcp" and parts.hostname:
                return asked
    return "opc.tcp://localhost/"
