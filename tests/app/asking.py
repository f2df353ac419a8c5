"""Requests to the workbench as they come from a socket, without one, and the folders that they are about."""

import asyncio
import json
import struct
import zlib
from dataclasses import dataclass, field
from types import SimpleNamespace
from urllib.parse import unquote

from bstcad.app import server
from bstcad.app.guard import Guard
from bstcad.app.preview_desk import PreviewDesk
from bstcad.app.workspace import LARGEST_UPLOAD, Workspace
from bstcad.designs.course import CurvePoint
from bstcad.report import record
from bstcad.report.goal_figures import GoalFigures
from tests.app.conftest import SMALL

PORT, TOKEN = 8123, "the-token-of-this-start"
HOST = f"127.0.0.1:{PORT}"
MB = 1_000_000


# ---- pictures --------------------------------------------------------------------------------------------------------


def chunk(kind, data):
    """A piece of a PNG file."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width, height, rows=None):
    """A grey PNG file that claims a size, and holds so many rows of pixels; None: all."""
    lines = (bytes((37 * x + 11 * y) % 256 for x in range(width)) for y in range(height if rows is None else rows))
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    data = zlib.compress(b"".join(b"\0" + line for line in lines))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


# ---- requests --------------------------------------------------------------------------------------------------------


@dataclass
class Answer:
    """The status, headers and body of an answer."""

    status: int = 0
    headers: list[tuple[str, str]] = field(default_factory=list)
    body: bytes = b""
    starts: int = 0  # number of answers that were begun: one
    taken: int = 0  # bytes of the request's body that were asked for
    error: BaseException | None = None  # exception that the application raised besides

    def __getitem__(self, name):
        """A header; "" if there is none."""
        return "; ".join(value for key, value in self.headers if key == name)

    @property
    def text(self):
        return self.body.decode("utf-8", "replace")

    @property
    def json(self):
        return json.loads(self.body)


@dataclass
class Asking:
    """A browser that has the cookie of an application."""

    app: object

    def __call__(self, target, body=b"", method=None, receive=None, **headers):
        """The answer; a header that is None is not sent.  body: a text, bytes, parts of them, or a table as JSON.

        receive: hands out the messages of the request instead.
        """
        body = json.dumps(body) if isinstance(body, dict) else body
        body = body.encode() if isinstance(body, str) else body
        parts = [body] if isinstance(body, bytes) else body
        method = method or ("POST" if body != b"" else "GET")
        own = {"host": HOST, "cookie": f"bstcad-{PORT}={TOKEN}"} | {k.replace("_", "-"): v for k, v in headers.items()}
        path, _, query = target.partition("?")
        scope = {
            "type": "http", "asgi": {"version": "3.0", "spec_version": "2.3"}, "http_version": "1.1", "scheme": "http",
            "method": method, "path": unquote(path), "raw_path": path.encode(), "query_string": query.encode(),
            "root_path": "", "client": ("127.0.0.1", 50000), "server": ("127.0.0.1", PORT),
            "headers": [(k.encode(), v.encode("latin-1")) for k, v in own.items() if v is not None],
        }  # fmt: skip
        return asyncio.run(self._asked(scope, iter(parts), receive))

    async def _asked(self, scope, parts, given=None):
        answer, over = Answer(), False

        async def receive():
            nonlocal over
            if over:
                await asyncio.Event().wait()  # it stays and listens
            part = next(parts, None)
            over = part is None
            answer.taken += len(part or b"")
            return {"type": "http.request", "body": part or b"", "more_body": not over}

        async def send(message):
            if message["type"] == "http.response.start":
                answer.starts += 1
                answer.status = message["status"]
                answer.headers = [(k.decode("latin-1").lower(), v.decode("latin-1")) for k, v in message["headers"]]
            else:
                answer.body += message.get("body", b"")

        try:
            await self.app(scope, given or receive, send)
        except Exception as error:
            answer.error = error
        return answer


# ---- a workbench -----------------------------------------------------------------------------------------------------


def contents(name, **more):
    """A report.json."""
    known = {
        "title": "A small disc", "verdict": "passed", "passed": True, "rrmsd": 0.02, "rrmsd_tent": None,
        "rrmsd_noise": 1e-4, "light_on_target": 0.9, "efficiency": 0.95, "flux": {"on target": 0.9},
        "prescription": {}, "seconds_total": 3.0, "stages": (), "history": (CurvePoint(1.0, 0.5),), "checks": (),
        "effects": {"simulated": (), "left_out": ()}, "machine": {}, "versions": {}, "seed": 0,
    }  # fmt: skip
    known |= more
    figures = {name: known.get(key) for key, name in record.WORST_GOAL_KEYS.items()}
    return record.Contents(name=name, **known, goals=(GoalFigures("target", "z = 500 mm", 1.0, **figures),))


def made(folder, **more):
    """A finished design in a folder; its files by name."""
    (folder / "figures").mkdir(parents=True)
    record.write_json(contents(folder.name, **more), folder / "report.json")
    files = {
        "scene.toml": SMALL.replace('name = "small"', f'name = "{folder.name}"').encode(),
        "lens.step": b"ISO-10303-21;\r\n" + bytes(range(256)) * 4096,
        "report.html": b"<!doctype html><script>parent.location</script>",
        "figures/irradiance.png": png(8, 8),
        "figures/deep/drawing.svg": b"<svg xmlns='http://www.w3.org/2000/svg' onload='alert(1)'/>",
        "nothing.txt": b"",
    }
    for name, data in files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(data)
    return files | {"report.json": (folder / "report.json").read_bytes()}


def bench(folder, monkeypatch):
    """A workbench whose previews nobody makes, with the scene small.toml: its parts, and a function that asks it."""
    monkeypatch.setattr(PreviewDesk, "_work", lambda self: None)
    folder.mkdir(exist_ok=True)
    (folder / "small.toml").write_text(SMALL, encoding="utf-8")
    workspace = Workspace(folder, folder)
    workbench = server.Workbench(workspace)
    guarded = Guard(workbench.app, PORT, TOKEN, larger=(server.UPLOAD, LARGEST_UPLOAD))
    return SimpleNamespace(ask=Asking(guarded), folder=folder, workspace=workspace, workbench=workbench)


def routes(workbench):
    """(path, method) of everything that the application answers; a mount by one of its files."""
    for route in workbench.app.routes:
        for method in sorted(getattr(route, "methods", None) or {"GET"}):
            yield (route.path if hasattr(route, "methods") else f"{route.path}/index.html"), method


def tree(folder):
    """All files of a folder with their bytes."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
