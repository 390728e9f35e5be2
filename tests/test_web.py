"""The small HTTP server: what it answers, and what it refuses to whom."""

import http.client
import json
import socket
import threading

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from calibration.web import CONNECTIONS, Reply, Request, WebServer, json_reply
from surfclass.errors import InputError

PAGE = '<script nonce="{{nonce}}">const token = "{{token}}"</script>'
LIMIT = 1000


def echo(request):
    return json_reply({"query": dict(request.query), "body": request.json()})


def broken(request):
    raise KeyError("a secret of the program")


def choosy(request):
    raise InputError("view 7: there are 3")


ROUTES = {
    ("POST", "/echo"): echo,
    ("GET", "/pixels"): lambda request: Reply(bytes(range(256)), "image/png"),
    ("GET", "/broken"): broken,
    ("GET", "/choosy"): choosy,
    ("GET", "/query"): lambda request: json_reply(dict(request.query)),
}


@pytest.fixture(scope="module")
def server():
    with WebServer(PAGE, ROUTES, body_limit=LIMIT, timeout_s=1.0) as serving:
        yield serving


def ask(server, method, path, body=None, **headers):
    """Sends one request and returns status, headers and bytes."""
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
    try:
        connection.request(method, path, body, named)
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()
    finally:
        connection.close()


def post(server, path, body, **headers):
    return ask(server, "POST", path, body, **{"X-Token": server.token, **headers})


def raw(server, data, half_close=True):
    """Sends bytes as they are and returns all that comes back until the server closes."""
    with socket.create_connection(("127.0.0.1", server.port), timeout=10) as connection:
        connection.sendall(data)
        if half_close:
            connection.shutdown(socket.SHUT_WR)
        received = b""
        while chunk := connection.recv(4096):
            received += chunk
        return received


def test_the_page_gets_the_token_and_a_nonce_that_its_policy_names(server):
    status, headers, body = ask(server, "GET", "/")
    assert (status, headers["Content-Type"]) == (200, "text/html; charset=utf-8")
    nonce = body.decode().split('"')[1]
    assert f"script-src 'nonce-{nonce}'" in headers["Content-Security-Policy"]
    assert server.token in body.decode()
    assert nonce not in ask(server, "GET", "/")[2].decode()


def test_every_answer_forbids_foreign_loads_frames_and_caches(server):
    for path in ("/", "/pixels", "/nowhere"):
        headers = ask(server, "GET", path)[1]
        assert "default-src 'none'" in headers["Content-Security-Policy"]
        assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert headers["Cache-Control"] == "no-store"


def test_bytes_and_json_go_both_ways(server):
    assert ask(server, "GET", "/pixels")[2] == bytes(range(256))
    status, _, body = post(server, "/echo?a=1&b=%20x", json.dumps({"é": [1.5, None]}))
    assert status == 200
    assert json.loads(body) == {"query": {"a": "1", "b": " x"}, "body": {"é": [1.5, None]}}


def test_one_connection_carries_many_requests(server):
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
    for _ in range(3):
        connection.request("POST", "/echo", "{}", {"X-Token": server.token})
        answer = connection.getresponse()
        assert (answer.status, answer.version) == (200, 11)
        answer.read()
    connection.close()


@pytest.mark.parametrize(
    "host", ["attacker.example", "attacker.example:80", "127.0.0.1.nip.io", "10.0.0.1", "", "[::1"]
)
def test_a_host_that_is_not_this_machine_is_refused(server, host):
    assert ask(server, "GET", "/", Host=host)[0] == 403


@pytest.mark.parametrize("host", ["localhost:9000", "LOCALHOST", "127.0.0.1", "[::1]:80", "127.8.8.8:1"])
def test_this_machine_by_any_of_its_own_names_is_let_in_as_through_a_tunnel(server, host):
    assert ask(server, "GET", "/", Host=host)[0] == 200


def test_a_request_with_two_hosts_or_none_is_refused(server):
    assert b" 403 " in raw(server, b"GET / HTTP/1.1\r\n\r\n")
    assert b" 403 " in raw(server, b"GET / HTTP/1.1\r\nHost: localhost\r\nHost: localhost\r\n\r\n")


def test_a_post_needs_the_token_and_if_it_names_an_origin_ours(server):
    assert ask(server, "POST", "/echo", "{}")[0] == 403
    for token in ("", "guess", server.token[:-1], "ü"):
        assert post(server, "/echo", "{}", **{"X-Token": token.encode()})[0] == 403
    assert post(server, "/echo", "{}", Origin="https://attacker.example")[0] == 403
    assert post(server, "/echo", "{}", Origin="null")[0] == 403
    assert post(server, "/echo", "{}", Origin=f"http://127.0.0.1:{server.port}")[0] == 200
    assert post(server, "/echo", "{}", Origin="http://localhost:9000", Host="localhost:9000")[0] == 200


def test_each_run_has_its_own_token(server):
    with WebServer(PAGE, {}) as other:
        assert other.token != server.token


def test_unknown_paths_and_methods_are_told_apart(server):
    assert ask(server, "GET", "/nowhere")[0] == 404
    status, _, body = ask(server, "GET", "/echo")
    assert (status, json.loads(body)) == (405, {"error": "allowed: POST"})
    assert post(server, "/", "")[0] == 405
    assert ask(server, "DELETE", "/")[0] == 501


def test_a_body_that_is_too_large_is_refused_before_it_is_read(server):
    status, _, body = post(server, "/echo", b" " * (LIMIT + 1))
    assert status == 413
    assert f"allowed are {LIMIT}" in json.loads(body)["error"]
    assert post(server, "/echo", b'"' + b"a" * (LIMIT - 2) + b'"')[0] == 200
    told = f"POST /echo HTTP/1.1\r\nHost: localhost\r\nX-Token: {server.token}\r\n".encode()
    assert b" 413 " in raw(server, told + b"Content-Length: 99999999999999999999999\r\n\r\n")


@pytest.mark.parametrize(
    ("lines", "status"),
    [
        (b"", 411),
        (b"Content-Length: 2\r\nContent-Length: 2\r\n", 400),
        (b"Content-Length: -1\r\n", 400),
        (b"Content-Length: 0x2\r\n", 400),
        (b"Content-Length: \xb2\r\n", 400),
        (b"Transfer-Encoding: chunked\r\n", 501),
        (b"Content-Length: 50\r\n", 400),
    ],
)
def test_a_body_without_one_true_length_is_refused_and_ends_the_connection(server, lines, status):
    head = f"POST /echo HTTP/1.1\r\nHost: localhost\r\nX-Token: {server.token}\r\n".encode()
    smuggled = b"GET / HTTP/1.1\r\nHost: x\r\n\r\n"
    answer = raw(server, head + lines + b"\r\n" + smuggled)
    assert answer.startswith(f"HTTP/1.1 {status} ".encode())
    assert answer.count(b"HTTP/1.1") == 1


def test_a_body_that_stops_coming_is_given_up(server):
    head = f"POST /echo HTTP/1.1\r\nHost: localhost\r\nX-Token: {server.token}\r\nContent-Length: 9\r\n\r\n{{"
    assert b" 408 " in raw(server, head.encode(), half_close=False)


@pytest.mark.parametrize("body", [b"", b"{", b"\xff", b"NaN", b"[1e999]", b"-Infinity", b"[" * 900])
def test_what_is_no_json_is_refused_with_the_reason(server, body):
    status, _, answer = post(server, "/echo", body)
    assert status == 400
    assert json.loads(answer)["error"].startswith("the body is not JSON")


def test_numbers_of_very_many_digits_are_refused():
    with pytest.raises(InputError):
        Request({}, b"1" * 5000).json()


def test_a_handlers_refusal_is_told_and_its_failure_is_not_shown(server, caplog):
    assert json.loads(ask(server, "GET", "/choosy")[2]) == {"error": "view 7: there are 3"}
    status, _, body = ask(server, "GET", "/broken")
    assert (status, b"secret" in body) == (500, False)
    assert "a secret of the program" in caplog.text


def test_a_query_of_very_many_fields_is_refused(server):
    assert ask(server, "GET", "/query?" + "&".join(f"a{i}=1" for i in range(17)))[0] == 400


@given(
    st.one_of(
        st.binary(max_size=300),
        st.tuples(
            st.sampled_from([b"GET", b"POST", b"get", b"PRI", b"\x00"]),
            st.sampled_from([b"/", b"//[", b"http://x/", b"*", b"/echo?a=%ff&&=", b"/" + b"a" * 70000]),
            st.sampled_from([b"HTTP/1.1", b"HTTP/1.0", b"HTTP/9", b"HTTP/", b""]),
            st.lists(st.tuples(st.binary(max_size=20), st.binary(max_size=20)), max_size=5),
        ).map(
            lambda parts: (
                b" ".join(parts[:3]) + b"\r\n" + b"".join(b": ".join(p) + b"\r\n" for p in parts[3]) + b"\r\n"
            )
        ),
    )
)
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_garbage_gets_an_error_or_nothing_and_hurts_nobody(server, caplog, garbage):
    caplog.clear()
    answer = raw(server, garbage)
    assert not answer.startswith(b"HTTP/1.1 2")
    assert not answer.startswith(b"HTTP/1.1 500")
    assert "Traceback" not in caplog.text
    assert ask(server, "GET", "/pixels")[0] == 200


def test_connections_beyond_the_limit_are_turned_away_and_the_rest_served(server):
    opened = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(CONNECTIONS + 5)]
    opened[-1].settimeout(10)
    assert opened[-1].recv(1) == b""
    for connection in opened:
        connection.close()
    for _ in range(100):
        try:
            assert ask(server, "GET", "/pixels")[0] == 200
            break
        except (http.client.RemoteDisconnected, ConnectionResetError):
            continue
    else:
        pytest.fail("nobody is served any more")


def test_the_end_lets_a_request_at_work_finish_and_waits_for_no_idle_browser():
    begun, go_on = threading.Event(), threading.Event()

    def slow(request):
        begun.set()
        assert go_on.wait(10)
        return json_reply("done")

    server = WebServer(PAGE, {("GET", "/slow"): slow}, timeout_s=60)
    with server:
        idle = http.client.HTTPConnection("127.0.0.1", server.port)
        idle.request("GET", "/")
        idle.getresponse().read()
        answers = []
        asking = threading.Thread(target=lambda: answers.append(ask(server, "GET", "/slow")))
        asking.start()
        assert begun.wait(10)
        threading.Timer(0.2, go_on.set).start()
    asking.join(10)
    assert answers[0][2] == b'"done"'
    idle.close()
    server.close()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", server.port), timeout=5)


def test_an_address_that_cannot_be_listened_at_is_named(server):
    with pytest.raises(InputError, match=f"port {server.port}: .*in use"):
        WebServer(PAGE, {}, port=server.port)
    with pytest.raises(InputError, match="port 70000"):
        WebServer(PAGE, {}, port=70000)
    with pytest.raises(InputError, match="cannot listen at 192"):
        WebServer(PAGE, {}, host="192.0.2.1")


def test_on_another_interface_any_address_is_a_host_and_no_foreign_name():
    with WebServer(PAGE, {}, host="0.0.0.0") as server:
        assert ask(server, "GET", "/", Host="192.168.1.20:80")[0] == 200
        assert ask(server, "GET", "/", Host="attacker.example")[0] == 403
