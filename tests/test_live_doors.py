"""The operator's page over real sockets: access, messages, malformed input, overload, the end."""

import json
import signal
import socket
from contextlib import ExitStack

import pytest
import websockets
from live_server import RIG, pictures_in, scene_in, served
from patience import PATIENCE_S, wait_until
from websockets.sync.client import connect


@pytest.fixture(scope="module")
def page():
    with served() as running:
        yield running


def open_socket(page, **given):
    options = {"additional_headers": {"Cookie": page.cookie}, "origin": page.base, **given}
    url = f"{options.pop('url', page.base).replace('http', 'ws')}/socket"
    # Closing does not wait for messages that were not read.
    return connect(url, max_size=None, open_timeout=PATIENCE_S, close_timeout=0.2, **options)


def next_moment(ws):
    while True:
        message = ws.recv(timeout=PATIENCE_S)
        if isinstance(message, bytes):
            ws.send('{"do":"ack"}')
            return message


def next_state(ws):
    while True:
        message = ws.recv(timeout=PATIENCE_S)
        if isinstance(message, bytes):
            ws.send('{"do":"ack"}')
        elif "state" in json.loads(message):
            return json.loads(message)["state"]


def read_to_the_end(ws):
    while True:
        ws.recv(timeout=PATIENCE_S)


def raw(page, request=b""):
    connection = socket.create_connection(("127.0.0.1", page.port), timeout=PATIENCE_S)
    connection.sendall(request)
    return connection


def is_one_line(text):
    return len(text.strip()) > 10 and text.count("\n") == 1 and "Traceback" not in text


# --- access ----------------------------------------------------------------------------------


def test_the_address_opens_the_page_and_sets_a_strict_cookie(page):
    status, text, headers = page.ask("GET", f"/?token={page.token}")
    assert status == 200
    assert "<title>fingerpost</title>" in text
    cookie = headers["set-cookie"].lower()
    assert f"fingerpost-{page.port}=" in cookie
    assert "httponly" in cookie
    assert "samesite=strict" in cookie
    policy = headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy


def test_the_cookie_alone_is_enough(page):
    assert page.ask("GET", "/main.js", Cookie=page.cookie)[0] == 200


@pytest.mark.parametrize(
    "path", ["/", "/main.js", "/?token=", "/?token=guess", "/main.js?token={}"]
)
def test_without_the_token_nothing_is_shown(page, path):
    status, text, headers = page.ask("GET", path.format(page.token))
    assert status == 403
    assert is_one_line(text)
    assert "set-cookie" not in headers


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{}", "127.0.0.1", "127.0.0.1:1", ""]
)
def test_requests_for_another_host_are_refused(page, host):
    status, text, _ = page.ask(
        "GET", f"/?token={page.token}", Host=host.format(page.port), Cookie=page.cookie
    )
    assert status == 400
    assert is_one_line(text)


@pytest.mark.parametrize("origin", ["http://evil.example", "null", None, "http://127.0.0.1:1"])
def test_a_websocket_of_another_origin_is_refused(page, origin):
    with pytest.raises(websockets.InvalidStatus) as refused:
        open_socket(page, origin=origin)
    assert refused.value.response.status_code == 403
    assert is_one_line(refused.value.response.body.decode())


def test_a_websocket_without_the_token_is_refused(page):
    with pytest.raises(websockets.InvalidStatus) as refused:
        open_socket(page, additional_headers={"Cookie": f"fingerpost-{page.port}=guess"})
    assert refused.value.response.status_code == 403


def test_post_requests_are_refused(page):
    assert page.ask("POST", "/", Cookie=page.cookie, Origin="http://evil.example")[0] == 403
    assert page.ask("POST", "/", Cookie=page.cookie, Origin=page.base)[0] == 405


@pytest.mark.parametrize("path", ["/../web.py", "/%2e%2e/web.py", "//etc/passwd", "/..%5cweb.py"])
def test_no_path_leads_out_of_the_page(page, path):
    assert page.ask("GET", path, Cookie=page.cookie)[0] == 404


# --- messages --------------------------------------------------------------------------------


def test_moments_come_with_both_pictures(page):
    with open_socket(page) as ws:
        while (rig := next_state(ws).get("rig")) is None:  # the page is there before the rig
            pass
        assert rig["views"] == ["left", "right"]
        moment = next_moment(ws)
        assert all(picture[:2] == b"\xff\xd8" for picture in pictures_in(moment))
        assert len(scene_in(moment)["views"]) == 2


def test_a_recording_is_stopped_stepped_and_scrubbed_by_command(page):
    with open_socket(page) as ws:
        next_state(ws)
        ws.send('{"do":"take"}')
        ws.send('{"do":"stop"}')
        ws.send('{"do":"seek","number":40}')
        while scene_in(next_moment(ws))["number"] != 40:
            pass
        ws.send('{"do":"step","by":-1}')
        back = scene_in(next_moment(ws))
        assert back["number"] == 39
        ws.send('{"do":"step","by":1}')
        assert scene_in(next_moment(ws))["number"] == 40
        ws.send('{"do":"seek","number":39}')
        assert scene_in(next_moment(ws)) == back


# --- malformed input and overload ------------------------------------------------------------


@pytest.mark.parametrize("nonsense", ['{"do":', "hello", '{"do":"format"}', b"\x00\x01", '"' * 9])
def test_malformed_messages_are_refused_in_one_line(page, nonsense):
    with open_socket(page) as ws:
        ws.send(nonsense)
        with pytest.raises(websockets.ConnectionClosedError) as closed:
            read_to_the_end(ws)
        assert closed.value.rcvd.code in (1003, 1007)
        assert closed.value.rcvd.reason


def test_an_oversized_message_is_refused(page):
    with open_socket(page) as ws:
        ws.send("x" * 100_000)
        with pytest.raises(websockets.ConnectionClosedError) as closed:
            read_to_the_end(ws)
        assert closed.value.sent.code == 1009 or closed.value.rcvd.code == 1009


@pytest.mark.parametrize(
    "request_text",
    [b"\x16\x03\x01\x02\x00", b"GET\r\n\r\n", b"GET / HTTP/1.1\r\nHost: " + b"x" * 100_000],
)
def test_malformed_requests_are_refused(page, request_text):
    with raw(page, request_text) as connection:
        assert connection.recv(4096).startswith(b"HTTP/1.1 4")


def test_a_hundred_slow_connections_do_not_disturb_the_page(page):
    with open_socket(page) as ws:
        next_state(ws)
        ws.send('{"do":"take"}')
        ws.send('{"do":"seek","number":0}')
        ws.send('{"do":"play"}')
        slow = [raw(page, b"GET / HTTP/1.1\r\nX-Slow: ") for _ in range(100)]
        try:
            numbers = {scene_in(next_moment(ws))["number"] for _ in range(20)}
            assert len(numbers) == 20
            ends = [connection.recv(4096) for connection in slow]
            said = [end.partition(b"\r\n\r\n")[2].decode() for end in ends]
            assert all(is_one_line(words) for words in said)
            assert sum(end.startswith(b"HTTP/1.1 503") for end in ends) >= 30
            assert sum(end.startswith(b"HTTP/1.1 408") for end in ends) >= 30
        finally:
            for connection in slow:
                connection.close()
        assert page.ask("GET", "/main.js", Cookie=page.cookie)[0] == 200


def test_too_many_pages_are_refused_in_one_line(page):
    with ExitStack() as stack:
        for _ in range(12):
            stack.enter_context(open_socket(page))
        with pytest.raises(websockets.InvalidStatus) as refused:
            stack.enter_context(open_socket(page))
    assert refused.value.response.status_code == 503
    assert is_one_line(refused.value.response.body.decode())


def test_a_stalled_page_gets_two_moments_and_does_not_delay_the_others(page):
    with open_socket(page) as stalled, open_socket(page) as quick:
        next_state(quick)
        quick.send('{"do":"take"}')
        quick.send('{"do":"seek","number":0}')
        quick.send('{"do":"play"}')
        for _ in range(40):
            next_moment(quick)
        moments = 0
        while moments < 2:
            moments += isinstance(stalled.recv(timeout=PATIENCE_S), bytes)
        # Only states come after them, whatever the other page was sent meanwhile.
        assert all(isinstance(stalled.recv(timeout=PATIENCE_S), str) for _ in range(10))


# --- the end ---------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_cleanly_with_clients_connected(number):
    with served() as running:
        with open_socket(running) as ws, raw(running):
            next_moment(ws)
            running.process.send_signal(number)
            code, said = running.end()
            with pytest.raises(websockets.ConnectionClosed):
                read_to_the_end(ws)
        assert code == 130
        assert said.strip() == "fingerpost: stopped"


def test_its_server_ends_when_it_is_killed():
    with served() as running:
        running.process.kill()
        running.process.wait()

        def refuses():
            try:
                raw(running).close()
            except ConnectionRefusedError:
                return True
            return False

        wait_until(refuses)


def test_a_rig_that_cannot_be_used_ends_it_in_one_line(tmp_path):
    broken = tmp_path / "rig.toml"
    broken.write_text(RIG.read_text().replace("left.mp4", str(tmp_path / "none.mp4")))
    with pytest.raises(AssertionError, match=r"none\.mp4"), served(broken) as running:
        raise AssertionError(running.end()[1])


@pytest.mark.parametrize("host", ["0.0.0.0", "here", "::1"])
def test_a_host_that_is_no_ipv4_address_of_this_machine_is_refused(host):
    with (
        pytest.raises(AssertionError, match="IPv4 address of this machine"),
        served(RIG, "--host", host),
    ):
        pass
