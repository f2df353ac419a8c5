"""The server answers the person at the terminal alone, and takes nothing that is too large or no picture."""

import asyncio
import contextlib
import http.client
import io
import json
import re
import socket
import threading
import time
from types import SimpleNamespace

import pytest
from PIL import Image

from bstcad.app import guard, server
from bstcad.app.design_runs import Run
from bstcad.app.guard import MAX_BODY_SIZE, REFUSALS, Guard
from bstcad.app.preview_desk import PreviewDesk
from bstcad.app.workspace import LARGEST_UPLOAD, Workspace
from tests.app.asking import HOST, MB, PORT, TOKEN, Asking, bench, chunk, made, png, routes, tree

OTHER = "the-token-of-another-start"


@pytest.fixture
def own(tmp_path, monkeypatch):
    found = bench(tmp_path / "lenses", monkeypatch)
    made(found.folder / "made")
    return found


def change(ask, **headers):
    """Ask for a change of a scene."""
    return ask("/api/scene/small/change", {"key": "target.z", "words": "777"}, **headers)


def refused(answer, why):
    """Is it refused for that reason, with nothing of the folder in it?"""
    return (answer.status, answer.text) == (403, REFUSALS[why]) and not answer["set-cookie"]


# ---- who is let in ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "cookie",
    [
        None, "nonsense", f"bstcad-{PORT}=", f"bstcad-{PORT}={TOKEN[:-1]}", f"bstcad-{PORT}={TOKEN}x",
        f"bstcad-{PORT + 1}={TOKEN}", f"token={TOKEN}", f"bstcad-{PORT}=\u00e9", f"bstcad-{PORT}={TOKEN.upper()}",
    ],
)  # fmt: skip
def test_without_the_cookie_of_this_start_nothing_is_told_or_done(own, cookie):
    before = tree(own.folder)
    assert refused(own.ask("/", cookie=cookie), "token")
    assert refused(change(own.ask, cookie=cookie), "token")
    assert tree(own.folder) == before


def test_another_start_knows_neither_cookie_nor_address(own):
    anew = Asking(Guard(own.workbench.app, PORT, OTHER))
    assert refused(anew("/"), "token")
    assert refused(anew(f"/?token={TOKEN}"), "token")


def test_every_route_refuses_who_has_no_cookie(own):
    asked = {(re.sub(r"\{\w+(:\w+)?\}", "small", path), method) for path, method in routes(own.workbench)}
    assert len(asked) > 25 and ("/api/picture", "POST") in asked
    asked |= {("/docs/index.html", "GET"), ("/no/such/page", "GET"), ("/", "DELETE"), ("/", "OPTIONS"), ("/", "TRACE")}
    for path, method in asked:
        assert refused(own.ask(path, method=method, cookie=None), "token"), (path, method)


HOSTILE = [
    "http://evil.example", "null", "", f"http://127.0.0.1:{PORT + 1}", f"https://{HOST}", f"http://{HOST}.evil.example",
    f"http://{HOST}@evil.example", f"http://{HOST}/",
]  # fmt: skip


@pytest.mark.parametrize("origin", HOSTILE)
def test_other_pages_are_refused_even_with_the_cookie(own, origin):
    before = tree(own.folder)
    assert refused(own.ask("/", origin=origin), "origin")
    assert refused(own.ask("/design/made/files/lens.step", origin=origin), "origin")
    assert refused(change(own.ask, origin=origin), "origin")
    assert refused(own.ask(f"/?token={TOKEN}", origin=origin, cookie=None), "origin")
    assert tree(own.folder) == before


@pytest.mark.parametrize("site", ["cross-site", "same-site", "nonsense"])
def test_what_a_browser_says_comes_from_elsewhere_is_refused(own, site):
    """`same-site`: another port of this machine, such as a notebook's."""
    assert refused(own.ask("/", sec_fetch_site=site), "origin")
    assert refused(change(own.ask, sec_fetch_site=site), "origin")


@pytest.mark.parametrize("site", ["same-origin", "none"])
def test_own_pages_and_typed_addresses_are_answered(own, site):
    assert own.ask("/", sec_fetch_site=site).status == 200
    assert change(own.ask, sec_fetch_site=site, origin=f"http://{HOST}").status == 200


@pytest.mark.parametrize(
    "host", [None, "", f"evil.example:{PORT}", "127.0.0.1", f"{HOST}.evil.example", f"0.0.0.0:{PORT}", f"x@{HOST}"]
)
def test_a_foreign_name_that_points_here_is_refused(own, host):
    before = tree(own.folder)
    assert refused(own.ask("/", host=host), "host")
    assert refused(own.ask(f"/?token={TOKEN}", host=host), "host")
    assert refused(change(own.ask, host=host, origin=f"http://{host}"), "host")
    assert tree(own.folder) == before


def test_sockets_are_closed_before_they_are_open(own):
    said = []

    async def inside(scope, receive, send):
        raise AssertionError("it was let in")

    async def send(message):
        said.append(message["type"])

    headers = [(b"host", HOST.encode()), (b"cookie", f"bstcad-{PORT}={TOKEN}".encode())]
    scope = {"type": "websocket", "path": "/", "query_string": b"", "headers": headers}
    asyncio.run(Guard(inside, PORT, TOKEN)(scope, None, send))
    assert said == ["websocket.close"]


# ---- the address of the terminal -------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", ["/", "/scene/small"])
def test_the_terminals_address_sets_the_cookie_and_leads_on_without_the_token(own, path):
    answer = own.ask(f"{path}?token={TOKEN}", cookie=None)
    assert (answer.status, answer["location"], answer.body) == (303, path, b"")
    name, *rest = answer["set-cookie"].split("; ")
    assert name == f"bstcad-{PORT}={TOKEN}"
    assert {each.casefold() for each in rest} == {"httponly", "samesite=strict", "path=/"}  # and no domain
    assert own.ask(path, cookie=name).status == 200


def test_a_wrong_token_in_the_address_sets_no_cookie(own):
    for query in ("token=", f"token={OTHER}", f"token={TOKEN}x", "token=%ff"):
        assert refused(own.ask(f"/?{query}", cookie=None), "token"), query


def test_only_a_page_is_opened_by_the_token(own):
    """The token is no second way in: a form of another page could have it in its address."""
    assert refused(own.ask(f"/api/scenes?token={TOKEN}", {}, cookie=None), "token")
    assert own.workspace.scene_names() == ["small"]


@pytest.mark.parametrize(
    "path", ["//evil.example/", "///evil.example", "/%2F/evil.example", "/%5Cevil.example", "/%0d%0aX: y"]
)
def test_the_token_leads_to_no_other_server(own, path):
    where = own.ask(f"{path}?token={TOKEN}", cookie=None)["location"]
    assert re.fullmatch(r"/[^/\\\s].*", where), where


@pytest.mark.parametrize("path", ["/scene/small", '/"><script>alert(1)</script>'])
def test_from_another_page_the_terminals_address_leads_on_by_a_page_of_its_own(own, path):
    """A terminal in a web page: after a redirect the browser keeps back the strict cookie."""
    answer = own.ask(f"{path}?token={TOKEN}", cookie=None, sec_fetch_site="cross-site")
    assert answer.status == 200 and answer["set-cookie"].startswith(f"bstcad-{PORT}={TOKEN}; HttpOnly")
    [where] = re.findall(r'<meta http-equiv="refresh" content="0;url=([^"]*)">', answer.text)
    assert where.startswith("/") and TOKEN not in answer.text and "<script>" not in answer.text


# ---- what every answer says ------------------------------------------------------------------------------------------


def test_every_answer_has_the_policies(own, monkeypatch):
    def broken(self):
        raise RuntimeError(f"a fault in {own.folder}")

    answers = {
        "page": own.ask("/scene/small"),
        "json": own.ask("/api/scene/small"),
        "script": own.ask("/static/scene.js"),
        "refusal of the app": own.ask("/scene/none"),
        "no page": own.ask("/no/such/page"),
        "no method": own.ask("/api/scenes"),
        "file": own.ask("/design/made/files/lens.step"),
        "part of a file": own.ask("/design/made/files/lens.step", range="bytes=0-9"),
        "page of a design": own.ask("/design/made/files/report.html"),
        "archive": own.ask("/design/made/all.zip"),
        "not changed": own.ask("/static/scene.js", if_none_match=own.ask("/static/scene.js")["etag"]),
        "token": own.ask("/", cookie=None),
        "host": own.ask("/", host="evil.example"),
        "origin": own.ask("/", origin="null"),
        "size": own.ask("/api/scenes", b"{}", content_length=str(200 * MB)),
        "redirect": own.ask(f"/?token={TOKEN}"),
        "page that leads on": own.ask(f"/?token={TOKEN}", sec_fetch_site="cross-site"),
    }
    monkeypatch.setattr(Workspace, "scene_names", broken)
    answers["fault"] = own.ask("/")
    wanted = dict.fromkeys(answers, 200) | {
        "refusal of the app": 400, "no page": 404, "no method": 405, "part of a file": 206, "not changed": 304,
        "token": 403, "host": 403, "origin": 403, "size": 413, "redirect": 303, "fault": 500,
    }  # fmt: skip
    assert {name: answer.status for name, answer in answers.items()} == wanted
    for name, answer in answers.items():
        assert answer.starts == 1, name
        assert answer["x-content-type-options"] == "nosniff", name
        assert answer["referrer-policy"] == "no-referrer", name
        assert answer["cache-control"] == "no-store", name
        assert answer["cross-origin-resource-policy"] == "same-origin", name
        assert "access-control-allow-origin" not in dict(answer.headers), name
        policy = answer["content-security-policy"]
        assert "default-src" in policy and "'unsafe-eval'" not in policy and "http" not in policy, name
        assert len([key for key, _ in answer.headers if key == "content-security-policy"]) == 1, name
        assert str(own.folder) not in answer.text and "Traceback" not in answer.text, name
    script = re.search(r"(script-src|default-src) ([^;]*)", answers["page"]["content-security-policy"])[2]
    assert script == "'self'", "a page of the workbench runs no script that stands in it"
    assert "frame-ancestors 'none'" in answers["page"]["content-security-policy"]


# ---- what is taken ---------------------------------------------------------------------------------------------------


def endless(part=b"\xff" * MB, most=200):
    """200 MB, part by part; one object, so that keeping it would still not fill the memory."""
    return (part for _ in range(most))


@pytest.mark.parametrize("path", ["/api/picture", "/api/scenes"])
def test_what_states_that_it_is_too_large_is_not_read_at_all(own, path):
    before = tree(own.folder)
    answer = own.ask(path, endless(), content_length=str(200 * MB))
    assert (answer.status, answer.text, answer.taken) == (413, REFUSALS["size"], 0)
    assert tree(own.folder) == before


@pytest.mark.parametrize("length", [None, "10", "²"])
@pytest.mark.parametrize("path", ["/api/picture", "/api/scenes"])
def test_what_is_too_large_without_saying_so_is_read_no_further_than_the_limit(own, path, length, capfd):
    before, most = tree(own.folder), LARGEST_UPLOAD if path == "/api/picture" else MAX_BODY_SIZE
    answer = own.ask(path, endless(), content_length=length, transfer_encoding="chunked")
    assert (answer.status, answer.text, answer.starts) == (413, REFUSALS["size"], 1)
    assert most < answer.taken <= most + MB
    assert tree(own.folder) == before and "Traceback" not in "".join(capfd.readouterr())


def test_a_body_of_just_the_limit_is_taken(own):
    fits, over = (b" " * (MAX_BODY_SIZE - 2 + more) + b"{}" for more in (0, 1))
    assert own.ask("/api/scene/small/save", fits).status == 200
    assert own.ask("/api/scene/small/save", over).status == 413


def test_a_picture_may_be_larger_than_a_scene(own):
    file = io.BytesIO()
    Image.effect_noise((2100, 2100), 60).save(file, "bmp")
    assert len(file.getvalue()) > MAX_BODY_SIZE
    [name] = own.ask("/api/picture", file.getvalue()).json.values()
    assert (own.folder / "pictures" / name).read_bytes() == file.getvalue()


@pytest.mark.parametrize("body", ["[" * 100_000, '{"a":' * 100_000, "no JSON", "[]", '"x"', "null", b"\xff\xfe{}"])
@pytest.mark.parametrize("path", ["/api/scenes", "/api/scene/small/save"])
def test_what_is_no_table_of_json_is_refused(own, path, body):
    before = tree(own.folder)
    answer = own.ask(path, body)
    assert answer.status == 400 and "; " in answer.json["sentence"]
    assert tree(own.folder) == before


# ---- uploads ---------------------------------------------------------------------------------------------------------

NO_PICTURES = {
    "bomb": png(60_000, 60_000, rows=1),
    "a bomb below Pillow's own limit": png(9000, 9000, rows=1),
    "text": b"this is a text file that somebody called photo.png",
    "svg": b'<?xml version="1.0"?><svg xmlns="http://www.w3.org/2000/svg"><script>alert(1)</script></svg>',
    "nothing": b"",
    "a beginning": png(64, 64)[:20],
    "cut": png(64, 64)[:-30],
    "damaged": png(64, 64).replace(b"IDAT", b"IDAT\0", 1),
    "no pixels": b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", png(8, 8)[16:29]) + chunk(b"IEND", b""),
    "eps": b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n(/etc/passwd) run\n",
    "heic": b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(64),
}  # fmt: skip


@pytest.mark.parametrize("what", NO_PICTURES)
def test_what_is_no_picture_is_refused_in_a_sentence_and_not_kept(own, what):
    before, began = tree(own.folder), time.perf_counter()
    answer = own.ask("/api/picture", NO_PICTURES[what], method="POST", content_type="image/png")
    assert answer.status == 400 and answer.error is None, answer.error
    sentence = answer.json["sentence"]
    assert sentence.startswith("target.image: ") and "; " in sentence and "\n" not in sentence
    assert tree(own.folder) == before
    assert time.perf_counter() - began < 5.0  # s: what a bomb claims is not decoded


def test_a_picture_is_kept_whole_by_a_name_of_its_content(own):
    data, file = png(12, 8), io.BytesIO()
    [name] = own.ask("/api/picture", data).json.values()
    assert tree(own.folder / "pictures") == {name: data}
    assert re.fullmatch(r"[0-9a-f]{12}\.png", name)
    Image.new("L", (9, 7), 200).save(file, "jpeg")
    answer = own.ask("/api/picture", file.getvalue(), content_type="image/png")
    assert answer.json["picture"].endswith(".jpg")
    assert len(tree(own.folder / "pictures")) == 2


@pytest.mark.parametrize("sent", ["../../evil.png", "/etc/evil.png", 'é".png'])
def test_a_senders_name_changes_nothing(own, sent):
    data = png(12, 8)
    [name] = own.ask("/api/picture", data).json.values()
    before = tree(own.folder.parent)
    words = {"content_disposition": f'attachment; filename="{sent}"', "x_file_name": sent, "content_type": "text/html"}
    query = "name=../../evil.png&filename=evil.png&path=/tmp/evil.png"
    assert own.ask(f"/api/picture?{query}", data, **words).json == {"picture": name}
    assert tree(own.folder.parent) == before


# ---- a real socket ---------------------------------------------------------------------------------------------------


@pytest.fixture
def served(tmp_path, monkeypatch):
    """The workbench as the command serves it, in a thread; what it said, its address and its port."""
    monkeypatch.setattr(PreviewDesk, "_work", lambda self: None)
    bench(tmp_path / "lenses", monkeypatch)
    made(tmp_path / "lenses/made")
    servers, said, shown = [], [], []

    begin = server.uvicorn_server

    def begun(*given):
        servers.append(begin(*given))
        return servers[-1]

    monkeypatch.setattr(server, "uvicorn_server", begun)
    arguments = (tmp_path / "lenses", 0, said.append, shown.append)
    thread = threading.Thread(target=server.serve, args=arguments, daemon=True)
    thread.start()
    until = time.monotonic() + 30
    while not (servers and servers[0].started) and time.monotonic() < until:
        time.sleep(0.01)
    host, _, rest = shown[0].removeprefix("http://").partition("/")
    yield SimpleNamespace(said=said, host=host, port=int(host.partition(":")[2]), first=f"/{rest}", folder=arguments[0])
    servers[0].should_exit = True
    thread.join(20)
    assert not thread.is_alive()


def got(served, path, method="GET", body=None, **headers):
    """(status, headers, body) of a request; a header may be given more than once."""
    connection = http.client.HTTPConnection("127.0.0.1", served.port, timeout=20)
    with contextlib.closing(connection):
        connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
        for name, values in ({"host": served.host} | headers).items():
            for value in values if isinstance(values, list) else [values]:
                connection.putheader(name.replace("_", "-"), value)
        if body is not None:
            connection.putheader("content-length", str(len(body)))
        connection.endheaders(body)
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()


def test_the_address_that_the_terminal_shows_opens_the_workbench(served):
    assert served.first in served.said[0] and served.host in served.said[0]
    assert got(served, "/")[0] == 403
    status, headers, _ = got(served, served.first)
    assert (status, headers["location"]) == (303, "/")
    cookie = headers["set-cookie"].partition(";")[0]
    status, headers, page = got(served, "/", cookie=cookie)
    assert status == 200 and b"small.toml" in page
    assert headers["content-security-policy"] == guard.POLICY and "server" not in headers
    token = cookie.partition("=")[2]
    assert len(token) >= 32 and token.encode() not in page


def test_a_socket_lets_in_no_more_than_the_guard(served):
    cookie = got(served, served.first)[1]["set-cookie"].partition(";")[0]
    change = {"method": "POST", "body": json.dumps({"key": "target.z", "words": "777"}).encode()}
    before, path = tree(served.folder), "/api/scene/small/change"
    for hostile in (
        {"host": f"evil.example:{served.port}"}, {"host": "evil.example"}, {"origin": "http://evil.example"},
        {"origin": "null"}, {"sec_fetch_site": "cross-site"}, {"cookie": "no=1"}, {"host": [served.host] * 2},
        {"host": []}, {"host": [served.host, "evil.example"]},
    ):  # fmt: skip
        for request in ({"path": "/"}, {"path": path, **change}):
            with contextlib.suppress(ConnectionResetError):  # a malformed request may be cut off
                status, _, body = got(served, **request, **({"cookie": cookie} | hostile))
                assert status in (400, 403) and b"small" not in body, (hostile, request)
    assert tree(served.folder) == before
    assert got(served, path, **change, cookie=cookie, origin=f"http://{served.host}")[0] == 200
    websocket = {"connection": "Upgrade", "upgrade": "websocket", "sec_websocket_version": "13"}
    assert got(served, "/", sec_websocket_key="dGhlIHNhbXBsZSBub25jZQ==", **websocket)[0] == 403
    assert got(served, "/", sec_websocket_key="dGhlIHNhbXBsZSBub25jZQ==", cookie=cookie, **websocket)[0] != 101


def test_a_socket_takes_the_points_of_a_measured_part(served, monkeypatch):
    """10 MB are a few hundred thousand points: more than a scene may have."""
    monkeypatch.setattr(Run, "_start", lambda self: None)
    cookie, data = got(served, served.first)[1]["set-cookie"].partition(";")[0], b"x,y,z\n" + b"1.0,2.0,3.0\n" * 800_000
    assert got(served, "/api/design/made/measured", method="POST", body=data, cookie=cookie)[0] == 200
    assert (Run(served.folder / "made", "measured").folder / "cloud.csv").read_bytes() == data


def test_only_this_machine_reaches_the_socket(served):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        with contextlib.suppress(OSError):
            probe.connect(("192.0.2.1", 9))  # nothing is sent
        outside = probe.getsockname()[0]
    for address in {"127.0.0.2", outside} - {"0.0.0.0", "127.0.0.1"}:
        with pytest.raises(OSError), socket.create_connection((address, served.port), timeout=5):
            pass
