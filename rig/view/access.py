"""Decides who may see the page: the address on which it listens, and the checks of Host, Origin and token. The page,
its files and its web sockets have the same checks.

A browser sends requests to the page on behalf of any page that it shows. Three things keep strangers out. `Host` must
name this computer: if the owner of a foreign page points its name to this computer (DNS rebinding), the browser still
sends that foreign name. `Origin`, which browsers send with every web socket, must be the page's own. And where the page
can be reached from other computers, a token is needed: first in the address, then in a cookie that scripts cannot read
and that is not sent on behalf of other pages.
"""

import hmac
import ipaddress
import os
import re
import secrets
import socket
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final
from urllib.parse import parse_qsl, urlsplit

from rig.errors import UsageError

FEWEST_TOKEN_CHARACTERS: Final = 16
_TOKEN = re.compile(r"[A-Za-z0-9_-]+", re.ASCII)
_HOST = re.compile(r"([A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\])(:[0-9]{1,5})?")
"""Form of the header Host: a name or a number, and a port."""


@dataclass(frozen=True, slots=True)
class Asked:
    """A request, as far as it is checked. hosts, origins, cookies: values of these headers, one for each header sent.

    path: with the query. socket: whether it asks for a web socket.
    """

    path: str
    socket: bool
    hosts: Sequence[str]
    origins: Sequence[str]
    cookies: Sequence[str]


@dataclass(frozen=True, slots=True)
class Refused:
    """A request that is not answered. status: of HTTP. why: a sentence for the person at the browser."""

    status: int
    why: str


@dataclass(frozen=True, slots=True)
class Access:
    """The rules of one page. address, port: where it listens. token: what must be sent with each request; None if no
    token is needed.

    names: host names under which the page may be asked for, besides IP addresses.
    """

    address: str
    port: int
    token: str | None
    names: frozenset[str] = field(default_factory=frozenset)

    @classmethod
    def to(cls, host: str, port: int, token: str | None) -> "Access":
        """The rules for a page at `host`, a name or an IP address. On an address other than loopback there is always a
        token, made here if none is given. Raises UsageError for a token that could be guessed or has other characters
        than letters, digits, - and _, for a port out of range, and for a host without an address. Only `listen` finds
        out whether the address is one of this computer."""
        if token is not None and (_TOKEN.fullmatch(token) is None or len(token) < FEWEST_TOKEN_CHARACTERS):
            raise UsageError(
                f"`token` has {len(token)} characters; it needs at least {FEWEST_TOKEN_CHARACTERS}, of letters, "
                "digits, - and _; leave it out, and one is made"
            )
        if not 0 <= port <= 65535:
            raise UsageError(f"`port` is {port}; it must be 1 to 65535, or 0 for any free one")
        try:
            address = str(socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0][4][0])
        except (OSError, UnicodeError) as error:
            reason = getattr(error, "strerror", None) or error
            raise UsageError(
                f"`host` is {host!r}, which is no address of this computer ({reason}); write 127.0.0.1 for this "
                "computer alone, 0.0.0.0 for the whole network, or one of its addresses"
            ) from None
        if is_loopback(address):
            return cls(address, port, token, frozenset({"localhost"}))
        own = socket.gethostname().lower()
        names = {"localhost", host.lower(), own, f"{own}.local", socket.getfqdn().lower()}
        return cls(address, port, token or secrets.token_urlsafe(24), frozenset(names))

    @property
    def cookie(self) -> str:
        """Name of the cookie. Browsers do not tell ports apart, so it has the port in it."""
        return f"spadrig-{self.port}"

    def url(self, name: str | None = None) -> str:
        """The page's address with its token. name: host name to use; None for the IP address on which the page
        listens."""
        host = name or self.address
        host = f"[{host}]" if ":" in host else host
        return f"http://{host}:{self.port}/" + (f"?token={self.token}" if self.token else "")

    def refusal(self, asked: Asked) -> Refused | None:
        """The reason why a request is not answered, or None if it is. Host and Origin are checked first, then the
        token, which comes in a cookie or in the address."""
        if len(asked.hosts) != 1 or not self._is_here(asked.hosts[0]):
            return Refused(421, "This page answers only to this computer's own name or number.")
        if len(asked.origins) > 1 or (asked.socket and not asked.origins):
            return Refused(403, "A web socket of this page is opened by the page itself alone.")
        if asked.origins and asked.origins[0] != f"http://{asked.hosts[0]}":
            return Refused(403, "This page answers to no other page.")
        if self.token is None or self._is_token(self._from_cookies(asked)) or self.brings_token(asked):
            return None
        return Refused(
            401, "This page needs a token. Open the whole address that 'rig view' printed, with ?token= at its end."
        )

    def knows(self, token: str) -> bool:
        """Whether this token is the right one. Always True if no token is needed."""
        return self.token is None or hmac.compare_digest(token.encode("utf-8", "replace"), self.token.encode())

    def brings_token(self, asked: Asked) -> bool:
        """Whether a request that is no web socket has the right token in its address. False if no token is needed."""
        if self.token is None or asked.socket:
            return False
        query = parse_qsl(asked.path.partition("?")[2])
        return self._is_token([value for name, value in query if name == "token"])

    def _is_token(self, given: Sequence[str]) -> bool:
        return any([self.knows(value) for value in given[:4]])

    def _from_cookies(self, asked: Asked) -> list[str]:
        pairs = [pair.strip().partition("=") for line in asked.cookies for pair in line.split(";")]
        return [value for name, _, value in pairs if name == self.cookie]

    def _is_here(self, host: str) -> bool:
        if _HOST.fullmatch(host) is None:  # it stands in the answer's security policy too
            return False
        try:
            name = (urlsplit(f"//{host}").hostname or "").rstrip(".")
        except ValueError:
            return False
        if name in self.names:
            return True
        try:
            number = ipaddress.ip_address(name)
        except ValueError:
            return False
        # A number is never a name that somebody else owns. On loopback even that is not left to chance.
        return number.is_loopback or not is_loopback(self.address)


def is_loopback(address: str) -> bool:
    """Whether only programs on this computer reach an IP address."""
    return ipaddress.ip_address(address.partition("%")[0]).is_loopback


def listen(access: Access) -> tuple[socket.socket, Access]:
    """A listening socket, and the rules with the port that the socket has got. On `::` it takes connections of IPv4
    too.

    Raises UsageError if the port is busy or the address is not one of this computer.
    """
    family = socket.AF_INET6 if ":" in access.address else socket.AF_INET
    both = access.address == "::" and socket.has_dualstack_ipv6()
    try:
        listening = socket.create_server((access.address, access.port), family=family, backlog=64, dualstack_ipv6=both)
    except OSError as error:
        reason = os.strerror(error.errno).lower() if error.errno else str(error)
        raise UsageError(
            f"cannot listen on port {access.port} of {access.address}: {reason}; end what uses it, or name another "
            "`port` or `host`"
        ) from None
    return listening, replace(access, port=listening.getsockname()[1])
