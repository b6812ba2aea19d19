"""Who may see the page: every check of Host, Origin and token, for files and for web sockets."""

from dataclasses import replace
from socket import create_connection, has_dualstack_ipv6

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.errors import UsageError
from rig.view.access import Access, Asked, is_loopback, listen

TOKEN = "a-token-that-is-long-enough"
HERE = Access("127.0.0.1", 8765, None, frozenset({"localhost"}))
LAB = Access("0.0.0.0", 8765, TOKEN, frozenset({"localhost", "scanner-pc"}))


def asked(
    path: str = "/", *, host: str | None = "127.0.0.1:8765", origin: str | None = None, socket: bool = False,
    cookie: str = "",
) -> Asked:  # fmt: skip
    return Asked(path, socket, [host] if host else [], [origin] if origin else [], [cookie] if cookie else [])


def status(access: Access, request: Asked) -> int | None:
    refusal = access.refusal(request)
    return None if refusal is None else refusal.status


@pytest.mark.parametrize("host", ["127.0.0.1:8765", "localhost:8765", "LOCALHOST:8765", "localhost:9000", "[::1]:8765"])
def test_on_loopback_its_names_are_answered_at_any_port_that_leads_here(host: str) -> None:
    assert status(HERE, asked(host=host)) is None
    assert status(HERE, asked("/data", host=host, origin=f"http://{host}", socket=True)) is None


@pytest.mark.parametrize(
    "host",
    ["evil.example", "evil.example:8765", "127.0.0.1.evil.example", "10.0.0.7:8765", "localhost.evil.example", "", "[",
     "127.0.0.1:8765; script-src *", "a@127.0.0.1", "127.0.0.1:8765\r\nX: y", "127.0.0.1/", "[::1]@evil.example"],
)  # fmt: skip
@pytest.mark.parametrize("socket", [False, True])
def test_a_foreign_name_is_refused_also_when_it_leads_here(host: str, socket: bool) -> None:
    request = asked("/data", host=host or None, origin=f"http://{host}", socket=socket)
    assert status(HERE, request) == 421
    assert status(HERE, replace(request, hosts=["127.0.0.1:8765", "127.0.0.1:8765"])) == 421


@pytest.mark.parametrize(
    "origin",
    [
        "http://evil.example",
        "http://127.0.0.1:9999",
        "https://127.0.0.1:8765",
        "null",
        "http://localhost:8765",
        "file://",
    ],
)
def test_another_page_is_refused_even_one_of_this_computer(origin: str) -> None:
    for path, socket in (("/", False), ("/data", True), ("/cloud", True)):
        assert status(HERE, asked(path, origin=origin, socket=socket)) == 403
    two = Asked("/", False, ["127.0.0.1:8765"], ["http://127.0.0.1:8765", origin], [])
    assert status(HERE, two) == 403


def test_a_web_socket_without_an_origin_is_refused() -> None:
    assert status(HERE, asked("/data", socket=True)) == 403
    assert status(HERE, asked("/", socket=False)) is None


@pytest.mark.parametrize("host", ["scanner-pc:8765", "192.168.1.20:8765", "[fe80::1]:8765", "localhost:8765"])
def test_on_the_network_nothing_is_answered_without_the_token(host: str) -> None:
    origin = f"http://{host}"
    for path, socket in (("/", False), ("/cloud/", False), ("/points.ply", False), ("/data", True), ("/cloud", True)):
        assert status(LAB, asked(path, host=host, origin=origin, socket=socket)) == 401
        for cookie in ("", "spadrig-8765=", f"spadrig-8766={TOKEN}", f"spadrig-8765={TOKEN[:-1]}", f"x={TOKEN}"):
            assert status(LAB, asked(path, host=host, origin=origin, socket=socket, cookie=cookie)) == 401
        right = asked(path, host=host, origin=origin, socket=socket, cookie=f"other=1; spadrig-8765={TOKEN}")
        assert status(LAB, right) is None


def test_a_token_in_the_address_opens_files_but_no_web_socket() -> None:
    address = f"/?token={TOKEN}"
    assert LAB.brings_token(asked(address))
    assert status(LAB, asked(address)) is None
    assert status(LAB, asked(f"/data?token={TOKEN}", origin="http://127.0.0.1:8765", socket=True)) == 401
    assert status(LAB, asked("/?token=")) == 401
    assert status(LAB, asked(f"/?token={TOKEN}x")) == 401
    assert not HERE.brings_token(asked(address))


def test_a_foreign_name_is_refused_with_the_right_token_too() -> None:
    assert status(LAB, asked(f"/?token={TOKEN}", host="evil.example")) == 421


@given(st.text(max_size=40), st.text(max_size=40), st.text(max_size=40), st.booleans())
def test_whatever_is_asked_is_answered_or_refused(path: str, host: str, cookie: str, socket: bool) -> None:
    for access in (HERE, LAB):
        refusal = access.refusal(Asked(path, socket, [host], [], [cookie]))
        assert refusal is None or refusal.status in (401, 403, 421)


def test_loopback_needs_no_token_and_every_other_address_gets_one_that_cannot_be_guessed() -> None:
    assert Access.to("127.0.0.1", 8765, None).token is None
    # Which of the two it is depends on the computer.
    assert Access.to("localhost", 8765, None).url() in ("http://127.0.0.1:8765/", "http://[::1]:8765/")
    first, second = (Access.to("0.0.0.0", 8765, None) for _ in range(2))
    assert first.token != second.token
    assert first.token is not None
    assert len(first.token) >= 32
    assert first.url("10.0.0.7") == f"http://10.0.0.7:8765/?token={first.token}"
    assert Access.to("127.0.0.1", 8765, TOKEN).token == TOKEN
    assert Access("::1", 1, None).url() == "http://[::1]:1/"


@pytest.mark.parametrize("token", ["", "short", "with a space in it, and long", "ä" * 20, "x" * 15])
def test_a_token_that_can_be_guessed_or_that_no_address_holds_is_refused(token: str) -> None:
    with pytest.raises(UsageError, match=rf"`token` has {len(token)} characters; it needs at least 16"):
        Access.to("127.0.0.1", 8765, token)


@pytest.mark.parametrize("port", [-1, 65536])
def test_a_port_that_does_not_exist_is_refused(port: int) -> None:
    with pytest.raises(UsageError, match=f"`port` is {port}; it must be 1 to 65535"):
        Access.to("127.0.0.1", port, None)


def test_a_host_that_is_no_address_is_named() -> None:
    with pytest.raises(UsageError, match=r"`host` is 'no such host', which is no address of this computer"):
        Access.to("no such host", 8765, None)


def test_loopback_is_known() -> None:
    assert [is_loopback(one) for one in ("127.0.0.1", "127.3.2.1", "::1", "0.0.0.0", "10.0.0.1", "fe80::1%eth0")] == [
        True, True, True, False, False, False,
    ]  # fmt: skip


@pytest.mark.skipif(not has_dualstack_ipv6(), reason="no IPv6 here")
def test_all_addresses_of_ipv6_are_those_of_ipv4_too() -> None:
    listening, access = listen(Access.to("::", 0, None))
    with listening:
        assert access.token is not None
        for address in ("127.0.0.1", "::1"):
            create_connection((address, access.port), timeout=10).close()


def test_a_port_is_bound_by_one_server_alone() -> None:
    listening, access = listen(Access.to("127.0.0.1", 0, None))
    with listening, pytest.raises(UsageError, match=f"port {access.port} of 127.0.0.1: address already in use; end wh"):
        listen(access)
