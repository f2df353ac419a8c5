"""A workspace that somebody sent, full of links and damaged files: every route answers below 500, and tells no secret.

The routes come from the server's own table, so that a new one is asked, too.
"""

import itertools
import json
import os
import shutil
import socket
import threading

import pytest

from bstcad.app import connections, design_runs, server
from bstcad.app.design_process import State
from bstcad.app.design_runs import JOBS, Run
from tests import suite
from tests.app.asking import bench, made, png, routes, tree
from tests.app.conftest import SMALL

SECRET = "secret-of-another-folder"
DEEP = "[" * 900 + "]" * 900
SCENE_OUTSIDE = SMALL.replace("An evenly", SECRET)


def outside(folder):
    """Files that no answer may hold and no request may change, in a folder beside the workspace."""
    folder.mkdir()
    small(folder / "design", title=SECRET)
    (folder / "secret.txt").write_text(SECRET)
    (folder / "secret.toml").write_text(SCENE_OUTSIDE)
    (folder / "secret.png").write_bytes(png(8, 8).replace(b"IEND", SECRET.encode()))
    run = folder / "run"
    run.mkdir()
    State("failed", sentence=SECRET).put(run)
    (run / "job.json").write_text('{"kind": "design"}')
    (run / "progress.jsonl").write_text(json.dumps([1.0, SECRET, 0, 1, SECRET]) + "\n")
    (run / "light.png").write_bytes((folder / "secret.png").read_bytes())
    (run / "scene.toml").write_text(SCENE_OUTSIDE)


def small(folder, **more):
    """Make a finished design of few bytes; its files."""
    files = made(folder, **more)
    (folder / "lens.step").write_bytes(b"ISO-10303-21;")
    return files


def links(folder, away):
    """Put links of each kind into a workspace; the names that a request may give for them."""
    folder.mkdir(exist_ok=True)
    (folder / "pictures").symlink_to(away)
    for name, place in {
        "root": "/", "away": away, "loop": "loop", "there": "back", "back": "there", "gone": away / "none",
        "linked": away / "design", "hard": "../outside/design",
    }.items():  # fmt: skip
        (folder / name).symlink_to(place)
        (folder / f"{name}.toml").symlink_to(place if name in ("loop", "there", "back") else away / "secret.toml")
    (folder / "there.toml").unlink()
    (folder / "there.toml").symlink_to("there.toml")
    (folder / "my-laser.toml").symlink_to(away / "not-there-yet.toml")
    small(folder / "within")
    for name in ("report.json", "scene.toml", "figures/irradiance.png", "lens.step"):
        (folder / "within" / name).unlink()
    (folder / "within/report.json").symlink_to(away / "design/report.json")
    (folder / "within/scene.toml").symlink_to(away / "secret.toml")
    (folder / "within/figures/irradiance.png").symlink_to(away / "secret.png")
    (folder / "within/lens.step").symlink_to(away / "secret.txt")
    (folder / "within/self").symlink_to("self")
    (folder / "within/deeper").symlink_to(away)
    (folder / "within/up").symlink_to("..")
    (folder / "within.toml").write_text(SMALL.replace("uniform = true", 'image = "pictures/secret.png"'))
    (folder / "net.toml").write_text(SMALL.replace('"plane", z = 0.0', '"bspline", z = 0.0, file = "linked"'))
    (folder / "text.toml").write_text(SMALL.replace("uniform = true", 'image = "away/secret.txt"'))
    (folder / "edited.toml").write_text(SMALL)
    (folder / ".edited.toml.unsaved").symlink_to(away / "secret.toml")
    for kind in JOBS:
        (folder / f".followed.{kind}-run").symlink_to(away / "run")
        run = Run(folder / "half", kind).folder
        run.mkdir()
        for name in ("state.json", "progress.jsonl", "light.png", "scene.toml", "job.json", "process.log"):
            (run / name).symlink_to(away / "run" / name)
    return (
        "root", "away", "loop", "there", "back", "gone", "linked", "hard", "within", "net", "text", "edited",
        "followed", "half", "my-laser",
    )  # fmt: skip


def damaged(folder, away):
    """Put damaged files of each kind into a workspace; the names that a request may give for them."""
    folder.mkdir(exist_ok=True)
    numbers = [b"NaN", b"Infinity", b"1e999", DEEP.encode(), b'"text"', b"null", b"{}", b"9" * 5000]
    contents = [b"", b"{", b"null", b"[]", b"\xff", DEEP.encode(), b'{"a":' * 900 + b"1" + b"}" * 900, b"\0" * 100]
    names = []
    for k, data in enumerate(contents):
        small(folder / f"d{k}")
        for name in ("report.json", "tolerance.json", "scene.toml", "lens.step"):
            (folder / f"d{k}" / name).write_bytes(data)
        (folder / f"d{k}.toml").write_bytes(data)
        (folder / f".d{k}.toml.unsaved").write_bytes(data)
        for kind in JOBS:
            run = Run(folder / f"d{k}", kind).folder
            run.mkdir()
            for name in ("state.json", "progress.jsonl", "light.png", "scene.toml", "job.json"):
                (run / name).write_bytes(data)
        names.append(f"d{k}")
    for k, data in enumerate(numbers):
        files = small(folder / f"n{k}")
        report = files["report.json"]
        (folder / f"n{k}/report.json").write_bytes(report.replace(b'"rrmsd": 0.02', b'"rrmsd": ' + data))
        (folder / f"n{k}/tolerance.json").write_bytes(b'{"yield": [' + data + b", 0.5, " + data + b"]}")
        (folder / f"n{k}.toml").write_text(SMALL.replace("100.0", data.decode()))
        for kind in JOBS:
            run = Run(folder / f"n{k}", kind).folder
            run.mkdir()
            fields = ("process", "began", "passed", "rrmsd", "folder", "sentence", "state")
            broken = fields[k % len(fields)]
            state = {"state": '"failed"', "rrmsd": "0.1", broken: data.decode()}
            if kind != "design":
                state = {"state": '"failed"', "rrmsd": data.decode()}
            text = ", ".join(f'"{key}": {value}' for key, value in state.items())
            (run / "state.json").write_text(f"{{{text}}}")
            lines = [[b"1.0", b'"a"', b"0", b"1", b'"b"'] for _ in range(5)]
            for place, line in enumerate(lines):
                line[place] = data
            (run / "progress.jsonl").write_bytes(b"".join(b"[" + b", ".join(line) + b"]\n" for line in lines))
        names.append(f"n{k}")
    for name in ("folders", "files"):
        made(folder / name)
    for name in ("folders.toml", ".folders.toml.unsaved", "folders/report.json", "folders/scene.toml"):
        path = folder / name
        path.unlink(missing_ok=True)
        path.mkdir()
        (path / "x").write_text("x")
    (folder / "files.toml").write_text(SMALL)
    for kind in JOBS:
        (folder / f".files.{kind}-run").write_text("a file")
    (folder / "pictures").write_text("a file")
    for name in (".two words.design-run", "..design-run", ".<b>.design-run"):
        (folder / name).mkdir()
        State("failed").put(folder / name)
    return (*names, "folders", "files")


DEEP_BODY = f'{{"page": "p", "number": 1, "key": "target.z", "light": "laser", "value": {DEEP}, "text": {DEEP}}}'
ASKED = {"page": "p", "number": 1, "light": "laser"}
ABOUT_SCENES = (
    ASKED | {"text": SMALL},
    ASKED | {"text": f"a = {DEEP}", "picture": "secret.png"},
    ASKED | {"key": "target.image", "words": "away/secret.png", "template": "thu", "sample": "astronaut"},
    ASKED | {"key": "lens.front.file", "words": "linked", "light": "lamp"},
    ASKED | {"key": "target.z", "value": float("nan")},
    DEEP_BODY,
)
ABOUT_DESIGNS = (
    {},
    {"budget": float("nan"), "yield": "nan"},
    {"yield": 1e999, "thickness": 1e999, "index": "x"},
    DEEP_BODY,
)
BODIES = {False: ABOUT_SCENES, True: ABOUT_DESIGNS}
QUERIES = {
    "/api/design/{name}/run": ("?kind=tolerance&since=0", "?since=0"),
    "/api/scene/{name}/answer": ("?page=p&number=1&stage=0", "?page=p&number=1&stage=1"),
    "/api/design/{name}/go-on": ("?kind=measured",),
    "/api/design/{name}/stop": ("?at_once",),
}
PLACES = (
    "report.html", "secret.txt", "etc/passwd", "deeper/secret.txt", "self", "up/../../outside/secret.txt",
    "%2e%2e/%2e%2e/outside/secret.txt", "..%2f..%2foutside/secret.txt", "lens.step", "report.json", "scene.toml",
    "figures/irradiance.png", "up/away/secret.txt", "up/root/etc/passwd", "../away/secret.txt",
)  # fmt: skip


def asked(path, method, names, bodies):
    """(address, body) of a route with every name, every file and so many bodies."""
    for name in names if "{name}" in path else ("",):
        for place in PLACES if "{path" in path else ("",):
            address = path.replace("{name}", name).replace("{path:path}", place)
            for query in ("", *QUERIES.get(path, ())):
                for body in BODIES[path.startswith("/api/design")][:bodies] if method == "POST" else (b"",):
                    yield f"{address}{query.replace('{name}', name)}", body
    if path == "/compare":
        yield from ((f"/compare?design={name}&design=within", b"") for name in names)


@pytest.fixture
def own(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr(server, "ANSWER_TIMEOUT", 0.0)
    monkeypatch.setattr(Run, "_wait_for_start", lambda self, process: None)
    begun = []
    monkeypatch.setattr(design_runs.subprocess, "Popen", lambda *given, **more: begun.append(given))
    outside(tmp_path / "outside")
    found = bench(tmp_path / "lenses", monkeypatch)
    found.outside, found.begun = tmp_path / "outside", begun
    return found


PARTS = 3  # number of parts of the requests; each commit sends one


@pytest.mark.parametrize("part", suite.in_turns(range(PARTS), PARTS))
@pytest.mark.parametrize(("kind", "bodies"), [(links, 6), (damaged, 1)])
def test_every_route_answers_about_a_hostile_workspace_and_tells_no_secret(own, kind, bodies, part, capsys):
    shutil.rmtree(own.folder)
    names, before, faults, count = kind(own.folder, own.outside), tree(own.outside), set(), 0
    kept = shutil.copytree(own.folder, own.folder.with_name("kept"), symlinks=True)
    for path, method in sorted(routes(own.workbench), key=lambda each: each[1]):  # what changes nothing comes first
        if method == "POST":
            shutil.rmtree(own.folder)
            shutil.copytree(kept, own.folder, symlinks=True)
        requests = asked(path, method, names, bodies) if method != "HEAD" else ()  # HEAD is a GET
        for address, body in itertools.islice(requests, part, None, PARTS):
            answer, count = own.ask(address, body, method), count + 1
            if answer.status >= 500 or answer.error is not None:
                faults.add((method, address, answer.status, repr(answer.error)[:100]))
            if SECRET in answer.text or "root:x:" in answer.text or str(own.folder) in answer.text:
                faults.add((method, address, "tells a secret"))
            if tree(own.outside) != before:
                faults.add((method, address, "wrote outside"))
                shutil.rmtree(own.outside)
                outside(own.outside)
    assert count > 500 / PARTS and not faults, "\n".join(map(str, sorted(faults)))
    assert "Traceback" not in capsys.readouterr().err


def test_a_link_made_after_the_list_is_not_followed(own):
    made(own.folder / "made")
    assert own.ask("/design/made/files/lens.step").status == 200
    shutil.move(own.folder / "made", own.folder / "moved")
    (own.folder / "made").symlink_to(own.outside / "design")
    for path in ("", "/files/lens.step", "/files/report.json", "/all.zip"):
        answer = own.ask(f"/design/made{path}")
        assert answer.status == 400 and SECRET not in answer.text and "leads out of" in answer.text, path


def test_links_within_the_workspace_are_served(own):
    """Only those that lead out of it are none of the workbench's business."""
    files = made(own.folder / "made")
    (own.folder / "again").symlink_to("made")
    (own.folder / "again.toml").symlink_to("small.toml")
    assert own.ask("/design/again/files/lens.step").body == files["lens.step"]
    assert own.ask("/api/scene/again").json["text"] == SMALL
    assert "again" in own.ask("/").text


def test_a_picture_that_the_scene_names_beside_the_workspace_is_the_persons_own(own):
    (own.outside / "photo.png").write_bytes(png(8, 8))
    for name in ("../outside/photo.png", str(own.outside / "photo.png")):
        text = SMALL.replace("uniform = true", f"image = {json.dumps(name)}")
        assert own.ask("/api/scene/small/change", {"text": text}).json["error"] is None
    (own.folder / "away").symlink_to(own.outside)
    text = SMALL.replace("uniform = true", 'image = "away/photo.png"')
    assert "leads out of" in own.ask("/api/scene/small/change", {"text": text}).json["error"]["sentence"]


@pytest.mark.parametrize("path", ["/api/picture", "/api/scene/small/change", "/api/design/made/measured"])
def test_an_upload_that_breaks_off_is_a_line_and_leaves_nothing(own, capsys, path):
    made(own.folder / "made")
    before = tree(own.folder)

    parts = iter([{"type": "http.request", "body": b"x" * 1000, "more_body": True}])

    async def receive():
        return next(parts, {"type": "http.disconnect"})

    answer = own.ask(path, b"", "POST", receive=receive)
    assert answer.error is None and answer.status < 500
    said = capsys.readouterr().err
    assert "Traceback" not in said and len(said.splitlines()) == 1 and path in said
    assert tree(own.folder) == before and own.begun == []


def test_unfinished_headers_are_closed(own, monkeypatch):
    monkeypatch.setattr(connections, "HEADERS_TIMEOUT", 0.2)
    with server.bound(0) as listening:
        port = listening.getsockname()[1]
        running = server.uvicorn_server(own.workbench.app)
        thread = threading.Thread(target=running.run, kwargs={"sockets": [listening]}, daemon=True)
        thread.start()
        try:
            for sent in (b"", b"GET / HTTP/1.1\r\nHost: x\r\n", b"G"):
                with socket.create_connection(("127.0.0.1", port), timeout=10) as slow:
                    slow.sendall(sent)
                    assert slow.recv(100) == b""
            with socket.create_connection(("127.0.0.1", port), timeout=10) as drop:
                closed = False
                for _ in range(40):  # a byte now and then keeps nothing open
                    drop.settimeout(0.1)
                    try:
                        drop.sendall(b"a")
                        closed = closed or drop.recv(100) == b""
                    except TimeoutError:
                        continue
                    except OSError:
                        closed = True
                    if closed:
                        break
                assert closed
            with socket.create_connection(("127.0.0.1", port), timeout=10) as whole:
                whole.sendall(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")
                answer = whole.recv(100)
                assert answer.startswith(b"HTTP/1.1 200")
                whole.sendall(b"GET / HT")  # the next request of the same connection
                while whole.recv(1 << 16):
                    pass
        finally:
            running.should_exit = True
            thread.join(10)


def test_names_of_links_that_lead_out_are_not_listed(own):
    names = links(own.folder, own.outside)
    words = own.ask("/").text
    for name in set(names) - {"within", "net", "text", "edited", "half"}:
        assert f"/design/{name}" not in words and f"/scene/{name}" not in words, name
    assert "small" in words and os.path.islink(own.folder / "root")
