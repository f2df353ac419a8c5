"""The server of the workbench: pages, and what their script asks for.  All of it on loopback, behind guard.py.

Nothing of a scene lives here alone: texts lie in the workspace, runs in their folders, and previews can be made again.
"""

from __future__ import annotations

import contextlib
import json
import re
import secrets
import signal
import sys
import traceback
import zipfile
from collections.abc import Awaitable, Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.staticfiles import StaticFiles

import bstcad
from bstcad import folder as folders
from bstcad.app import crop, design_runs, form, preview_json, scene_text, sketch
from bstcad.app.connections import bound, uvicorn_server
from bstcad.app.design_runs import WRITTEN, Run
from bstcad.app.followers import impossible, take_change
from bstcad.app.guard import POLICY, SANDBOX, Guard
from bstcad.app.preview_desk import STAGES, PreviewDesk
from bstcad.app.preview_desk import Request as PreviewRequest
from bstcad.app.workspace import LARGEST_UPLOAD, Workspace
from bstcad.report import manual, record
from bstcad.report.light_figures import View, dark_triptych
from bstcad.report.report import VIEWER, doubts
from bstcad.runs import files
from bstcad.runs.files import SentenceError
from bstcad.scene import new_scene, scene_file
from bstcad.scene.errors import SceneError, line_of, toml_positions
from bstcad.scene.picture import SAMPLES
from bstcad.scene.scene_file import DOTS
from bstcad.scene.schema import rows

Asked = Mapping[str, Any]  # table of JSON that a page sends
PATIENCE = 20.0  # seconds that an answer is waited for; then the page asks again
UPLOAD = "/api/picture"
LARGER = rf"{UPLOAD}|/api/design/[^/]+/measured"  # where more may be sent
STATIC = Path(__file__).parent / "static"
SHOWN = {".html": "text/html", ".json": "application/json", ".png": "image/png", ".pdf": "application/pdf"}
RRMSD = (
    "RRMSD states how far the light is from the picture: the root mean square of the difference, over that of the "
    "picture. 0 is the picture itself."
)
KEYS_PAGE = "reference/scene-keys"  # page of the documentation that is made of the schema
MOST_SOUND = 31  # scenes, besides the latest, whose latest valid text is kept
# Files that people come for, which a list begins with.
FIRST_FILES = ("lens.step", "part.step", "report.html", "datasheet.pdf", "lens.stl", "lens.3mf")
CLOUDS = ((b"ply", ".ply"), (b"solid", ".stl"))  # how files of measured points begin


class Workbench:
    """The application of one start."""

    def __init__(self, workspace: Workspace) -> None:
        self.workspace, self.desk = workspace, PreviewDesk()
        self.started: list[Run] = []  # by this server
        self._sound: dict[str, str] = {}  # the latest valid text of each scene of late, from which keys follow
        scene, design = "/api/scene/{name}", "/api/design/{name}"
        looked_at = {
            "/": self.start_page,
            "/scene/{name}": self.scene_page,
            "/design/{name}": self.design_page,
            "/compare": self.compare_page,
            "/solid_view.js": lambda request: FileResponse(VIEWER, media_type="text/javascript"),
            scene: self.scene_state,
            f"{scene}/photo.png": self.photo,
            f"{scene}/impossible": self.impossible_choices,
            f"{scene}/answer": self.answer,
            f"{design}/run": self.follow,
            f"{design}/light.png": self.light,
            f"{design}/irradiance-dark.png": self.dark_figure,
            "/design/{name}/all.zip": self.all_files,
            "/design/{name}/files/{path:path}": self.one_file,
        }
        sent = {
            UPLOAD: self.keep_picture,
            f"{scene}/drop": self.drop_changes,
            f"{design}/stop": self.stop,
            f"{design}/go-on": self.go_on,
            f"{design}/edit": self.edit,
            f"{design}/measured": self.measured,
            "/api/scenes": _of_json(self.add_scene),
            f"{scene}/change": _of_json(self.change_scene),
            f"{scene}/proportions": _of_json(self.take_proportions),
            f"{scene}/save": _of_json(self.save_scene),
            f"{scene}/preview": _of_json(self.preview),
            f"{scene}/make": _of_json(self.make),
            f"{design}/tolerance": _of_json(self.tolerance),
            f"{design}/tradeoff": _of_json(self.tradeoff),
        }
        routes = [Route(path, answer) for path, answer in looked_at.items()]
        routes += [Route(path, answer, methods=["POST"]) for path, answer in sent.items()]
        handlers = {
            SentenceError: self._refused, OSError: self._unusable, ClientDisconnect: self._broken_off,
            Exception: self._failed, 404: self._no_page,
        }  # fmt: skip
        self.app = Starlette(routes=routes, exception_handlers=handlers)
        self.app.mount("/static", StaticFiles(directory=STATIC))
        site = manual.site()
        self.has_docs = site is not None or manual.FIRST in manual.pages()
        if site is not None:
            self.app.mount("/docs", _Site(directory=site, html=True))
        elif self.has_docs:
            self.app.router.routes.append(Route("/docs/{page:path}", self.manual_page))

    def end(self) -> list[str]:
        """End the previews and the runs that this server began; a sentence on each run that was under way."""
        running = design_runs.end(self.started)
        self.desk.end()
        return design_runs.endings(running)

    def _refused(self, request: Request, error: Exception) -> Response:
        return self._told_of(request, str(error), 400)

    def _unusable(self, request: Request, error: Exception) -> Response:
        """A file or a folder that cannot be read or written: a folder in its place, a full disk."""
        assert isinstance(error, OSError)
        place = f"{Path(error.filename).name}: " if isinstance(error.filename, str) else ""
        words = f"{place}{error.strerror or type(error).__name__}"
        return self._told_of(request, f"{words}; check that it may be read and written, and that space is left", 400)

    def _broken_off(self, request: Request, error: Exception) -> Response:
        """A request whose sender went away: a line for the terminal; nobody reads the answer."""
        print(f"bstcad: {request.url.path}: was broken off by its sender; nothing of it is kept", file=sys.stderr)
        return Response(status_code=400)

    def _failed(self, request: Request, error: Exception) -> Response:
        """A fault of this program: a sentence for the page, the rest for the terminal."""
        traceback.print_exception(error)
        words = f"{type(error).__name__}: {files.first_line(error)}"
        return self._told_of(request, f"{words}; the terminal of the workbench says where it happened", 500)

    def _told_of(self, request: Request, sentence: str, status: int) -> Response:
        """A sentence without folders of this machine, as a script or a person asked for it."""
        sentence = self.workspace.without_paths(sentence)
        if not request.url.path.startswith("/api/"):
            return self._page("lost.html.j2", status=status, title="Not to be shown", sentence=sentence)
        return JSONResponse({"sentence": sentence}, status_code=status)

    def _no_page(self, request: Request, error: Exception) -> Response:
        return self._page("lost.html.j2", status=404, title="No such page", sentence="")

    def manual_page(self, request: Request) -> Response:
        """A page of the documentation as Markdown, where its pages are not built."""
        name = request.path_params["page"].removesuffix(".html")
        if name == KEYS_PAGE:
            keys = (f"{row.key}: {row.meaning} {row.unit}; {row.range}; {row.default}" for row in rows())
            text = "\n".join(["# Keys of a scene: meaning, unit, range, default", "", *keys])
        elif name in manual.pages():
            text = manual.first() if name == manual.FIRST else manual.page(name)
        else:
            return self._no_page(request, KeyError(name))
        return self._page("manual.html.j2", title="Documentation", text=text)

    def _page(self, template: str, status: int = 200, **values: Any) -> HTMLResponse:
        common = {"version": bstcad.__version__, "has_docs": self.has_docs, "rrmsd_words": RRMSD}
        return HTMLResponse(form.environment().get_template(template).render(**common, **values), status_code=status)

    # ---- pages ----

    def start_page(self, request: Request) -> Response:
        """Where a picture is dropped, and the list of scenes and designs."""
        return self._page(
            "start.html.j2", title="Workbench", samples=SAMPLES, templates=new_scene.templates(),
            scenes=self.workspace.scene_names(), designs=[*self._designs()],
        )  # fmt: skip

    def _designs(self) -> Iterator[dict[str, Any]]:
        """The designs that are finished or under way, a card each."""
        running = {run.design.name: run for run in design_runs.all_runs(self.workspace.designs) if run.kind == "design"}
        finished = self.workspace.design_names()
        for name in [*(name for name in running if name not in finished), *finished]:
            run, known = running.get(name), self._report(name) if name in finished else None
            state = run.state.state if run is not None else "none"
            yield {
                "name": name, "title": known.title if known else "", "verdict": known.verdict if known else "",
                "rrmsd": record.rrmsds(known) if known else "", "state": state,
                "picture": self._thumbnail(name, run),
            }  # fmt: skip

    def _thumbnail(self, name: str, run: Run | None) -> str:
        """The address of a design's picture; "" if it has none."""
        if (self.workspace.design(name) / "figures" / "irradiance.png").is_file():
            return f"/design/{name}/files/figures/irradiance.png"
        return f"/api/design/{name}/light.png" if run is not None and run.light else ""

    def _report(self, name: str) -> record.Contents | None:
        try:
            return record.read(self.workspace.file(name, "report.json"))
        except ValueError:
            return None

    def scene_page(self, request: Request) -> Response:
        """Where a scene is changed while its light is seen."""
        opened = self.workspace.opened(request.path_params["name"])
        return self._page("scene.html.j2", title=opened.name, name=opened.name, state=self._state(opened.name))

    def design_page(self, request: Request) -> Response:
        """A design under way or finished."""
        name = request.path_params["name"]
        folder, run = self.workspace.design(name), Run(self.workspace.design(name))
        known = self._report(name)
        if known is None and run.state.state == "none":
            raise SceneError(f"{name}: there is no such design; choose one of the list")
        names = self.workspace.file_names(name) if folder.is_dir() else []
        names.sort(key=lambda each: FIRST_FILES.index(each) if each in FIRST_FILES else len(FIRST_FILES))
        return self._page(
            "design.html.j2", title=name, name=name, report=known, files=names,
            rrmsd=record.rrmsds(known) if known else "", doubts=doubts(known) if known else (), run=self._news(run),
            jobs={kind: self._news(Run(folder, kind)) for kind in ("tolerance", "tradeoff", "measured")},
            has_light="figures/irradiance.png" in names,
        )  # fmt: skip

    def compare_page(self, request: Request) -> Response:
        """Two or more designs side by side: their pictures, their curves, and the keys in which they differ."""
        names = [name for name in request.query_params.getlist("design")][:4]
        known = [(name, self._report(name)) for name in names]
        found = [{"name": name, "report": report, "rrmsd": record.rrmsds(report)} for name, report in known if report]
        flat = [_flat(scene_file.read(self.workspace.file(each["name"], "scene.toml"))[1]) for each in found]
        keys = sorted({key for each in flat for key in each})
        rows = [(key, [each.get(key, "") for each in flat]) for key in keys if len({e.get(key) for e in flat}) > 1]
        curves = [[[point.seconds, point.rrmsd] for point in each["report"].history] for each in found]
        return self._page("compare.html.j2", title="Compared", designs=found, rows=rows, curves=json.dumps(curves))

    # ---- scenes ----

    def add_scene(self, _: str, asked: Asked) -> dict[str, Any]:
        """A new scene file: {light, size as of `bstcad new`, and picture, sample or text} or {template}."""
        known = {key: str(asked[key]) for key in ("sample", "text", "template") if asked.get(key)}
        image = str(asked["picture"]) if asked.get("picture") else None
        light = str(asked.get("light") or next(iter(new_scene.LIGHTS)))
        size = str(asked["size"])[:40] if asked.get("size") and "template" not in known else None
        return {"name": self.workspace.add(light, image=image, size=size, **known)}

    async def keep_picture(self, request: Request) -> Response:
        """Keep an uploaded picture, the body of the request; its name here."""
        data = await request.body()
        return JSONResponse({"picture": await run_in_threadpool(self.workspace.keep, data)})

    def scene_state(self, request: Request) -> Response:
        """A scene as it is being edited, its form and its fault."""
        known, name = request.query_params.get("revision"), request.path_params["name"]
        if known is not None and known == self.workspace.opened(name).revision:
            return JSONResponse({"revision": known})
        return JSONResponse(self._state(name))

    def _state(self, name: str) -> dict[str, Any]:
        opened = self.workspace.opened(name)
        told = {"name": name, "text": opened.text, "revision": opened.revision, "saved": opened.saved}
        try:
            data = scene_text.tables(opened.text)
        except SceneError as fault:
            at = re.search(r"at line (\d+)", str(fault))
            error = {"key": "", "sentence": str(fault), "line": int(at[1]) if at else None}
            return told | {"form": None, "error": error}
        error = self._fault(name, opened.text)
        if error is None:
            self._sound = {**dict([*self._sound.items()][-MOST_SOUND:]), name: opened.text}
        shown = form.form(data)
        told["design"] = data.get("name") if isinstance(data.get("name"), str) else name
        errors = {error["key"]: error["sentence"]} if error else {}
        page = form.html(shown, errors, self.has_docs)
        return told | {"form": page, "error": error, "sketch": sketch.svg(data)}

    def _fault(self, name: str, text: str) -> dict[str, Any] | None:
        """The fault of a scene: its key, the sentence of the terminal, and the line."""
        try:
            self.workspace.scene(name, text)
        except SentenceError as fault:
            sentence = self.workspace.without_paths(str(fault))
            key = sentence.partition(":")[0]
            return {"key": key, "sentence": sentence, "line": line_of(key, toml_positions(text))}
        return None

    def change_scene(self, name: str, asked: Asked) -> dict[str, Any]:
        """Another text, {text}, or another value as a person typed it, {key, words}; {key, value} as JSON has it.

        {locked: true}: the other side of a target or a lens keeps its ratio to the one that is changed.  The answer's
        `followed` names the keys that changed besides.
        """
        followed: list[str] = []

        def with_value(text: str) -> str:
            key, data = str(_given(asked, "key")), scene_text.tables(text)
            if key.count(".") > DOTS:
                raise SceneError(f"{key[:20]}…: is no key of a scene; reload the page")
            value = asked["value"] if "value" in asked else scene_text.typed(key, str(_given(asked, "words")), data)
            text, others = take_change(
                text, key, value, is_sound=lambda each: self._fault(name, each) is None, sound=self._sound.get(name),
                locked=asked.get("locked") is True,
            )  # fmt: skip
            followed.extend(others)
            return text

        if "text" in asked:
            self.workspace.change(name, str(asked["text"]).replace("\r\n", "\n"))
        else:
            self.workspace.edit(name, with_value)
        return self._state(name) | {"followed": followed}

    def photo(self, request: Request) -> Response:
        """The photo of a target, ?key, whole and small: a frame is dragged over it."""
        name, key = request.path_params["name"], request.query_params.get("key", "target")
        scene = self.workspace.scene(name, self.workspace.opened(name).text)
        return Response(crop.small_photo(crop.target_of(scene, key)), media_type="image/png")

    def take_proportions(self, name: str, asked: Asked) -> dict[str, Any]:
        """Give plate and picture the proportions of a target's photo: {key of the target}."""
        key = str(asked.get("key") or "target")

        def with_proportions(text: str) -> str:
            target = crop.target_of(self.workspace.scene(name, text), key)
            for other, value in crop.in_proportions(scene_text.tables(text), key, target).items():
                text = scene_text.changed(text, other, value)
            return text

        self.workspace.edit(name, with_proportions)
        return self._state(name)

    def impossible_choices(self, request: Request) -> Response:
        """The choices of the form that this scene cannot have: {key: {choice: why}}."""
        name = request.path_params["name"]
        text = self.workspace.opened(name).text
        return JSONResponse(impossible(text, lambda each: (self._fault(name, each) or {}).get("sentence")))

    def save_scene(self, name: str, asked: Asked) -> dict[str, Any]:
        """Put the text into the scene file; {anyway: true} over another program's."""
        self.workspace.save(name, anyway=bool(asked.get("anyway")))
        return self._state(name)

    def drop_changes(self, request: Request) -> Response:
        """Forget the changes that are not saved."""
        self.workspace.drop(request.path_params["name"])
        return JSONResponse(self._state(request.path_params["name"]))

    # ---- previews ----

    def preview(self, name: str, asked: Asked) -> dict[str, Any]:
        """The preview of the scene as it is: {page, number}.  {replaced: true} where the page asked again meanwhile."""
        text = self.workspace.opened(name).text
        page, number = str(_given(asked, "page"))[:40], _whole(_given(asked, "number"))
        asking = PreviewRequest(page, number, self.workspace.scene(name, text), text)
        self.desk.ask(asking)
        return self._answered(asking, 0)

    def answer(self, request: Request) -> Response:
        """A later answer to a request of a page: ?page, number and stage; {} if there is none yet."""
        query = request.query_params
        number, stage = _whole(_given(query, "number")), _whole(_given(query, "stage"))
        asked = self.desk.last(_given(query, "page"))
        if asked is None or asked.number != number or not 0 <= stage < len(STAGES):
            return JSONResponse({"replaced": True})
        return JSONResponse(self._answered(asked, stage))

    def _answered(self, asked: PreviewRequest, stage: int) -> dict[str, Any]:
        answer = self.desk.answer(asked, stage, PATIENCE)
        if answer is None:
            return {"replaced": True} if asked.replaced else {}
        name, found = answer
        head = {"stage": name, "number": asked.number}
        if isinstance(found, SentenceError):
            return head | {"refused": self.workspace.without_paths(str(found))}
        if isinstance(found, Exception):
            why = self.workspace.without_paths(files.first_line(found))
            return head | {"refused": f"no {name} could be made ({why}); a design may do better"}
        if name in ("preview", "settled"):
            return head | preview_json.of_preview(found)
        return head | (
            preview_json.of_plan(found) if name == "effects" else preview_json.of_predictions(found)
        )

    # ---- designs ----

    def make(self, name: str, asked: Asked) -> dict[str, Any]:
        """Save the scene and design it, in a process of its own: {page, which waits for no preview now}; its name."""
        self.desk.forget(str(asked.get("page")))
        text = self.workspace.opened(name).text
        scene = self.workspace.scene(name, text)
        self.workspace.save(name)
        folder = self.workspace.design(scene.name)
        folder.parent.mkdir(parents=True, exist_ok=True)
        self.started.append(design_runs.begin_design(scene, folder, text))
        return {"design": scene.name}

    def _run(self, request: Request) -> Run:
        kind = request.query_params.get("kind", design_runs.DESIGN)
        if kind not in design_runs.JOBS:
            raise SceneError(f"{kind}: is no kind of run; choose one of {', '.join(design_runs.JOBS)}")
        return Run(self.workspace.design(request.path_params["name"]), kind)

    def follow(self, request: Request) -> Response:
        """How a run stands, and its progress from line `since` on."""
        return JSONResponse(self._news(self._run(request), _whole(request.query_params.get("since", 0))))

    def _news(self, run: Run, since: int = 10**9) -> dict[str, Any]:
        """What there is to tell of a run, without folders of this machine."""
        news = run.news(since)
        news["sentence"] = self.workspace.without_paths(news["sentence"])
        for line in news["lines"]:
            line[4] = self.workspace.without_paths(line[4])
        return news

    def light(self, request: Request) -> Response:
        """The light through the best lens so far."""
        data = Run(self.workspace.design(request.path_params["name"])).light
        return Response(data, media_type="image/png") if data else Response(status_code=404)

    def dark_figure(self, request: Request) -> Response:
        """The figure of a finished design's irradiance for a page in dark mode; the usual one where that fails."""
        name = request.path_params["name"]
        usual = self.workspace.file(name, "figures/irradiance.png")
        try:
            folder = self.workspace.file(name, "design.npz").parent
            scene, nominal = folders.read_nominal(folder)
            found = nominal.goals[0].picture, folders.read_irradiances(folder, scene)[0]
            return Response(dark_triptych(*found, View.of(scene)), media_type="image/png")
        except SentenceError:
            return FileResponse(usual, media_type="image/png")

    def stop(self, request: Request) -> Response:
        """End a run: a design with the best lens so far, or at once with a checkpoint (?at_once)."""
        run = self._run(request)
        gently = run.kind == design_runs.DESIGN and "at_once" not in request.query_params
        run.signal(signal.SIGINT if gently else signal.SIGTERM)
        return JSONResponse({})

    def go_on(self, request: Request) -> Response:
        """Go on with a run that was stopped or killed."""
        run = self._run(request)
        run.go_on()
        self.started.append(run)
        return JSONResponse({})

    def edit(self, request: Request) -> Response:
        """A new scene file with the scene of a design; its name."""
        name = request.path_params["name"]
        folder = self.workspace.design(name)
        source = folder if (folder / "scene.toml").is_file() else Run(folder).place
        return JSONResponse({"name": self.workspace.adopt(name, source, Run(folder).place / WRITTEN)})

    def tolerance(self, name: str, asked: Asked) -> dict[str, Any]:
        """How exactly the lens must be made: {grade, yield in percent}, each perhaps absent."""
        wanted = asked.get("yield")
        share = None if wanted in (None, "") else _number(wanted, "yield") / 100
        if share is not None and not 0 < share < 1:
            raise SceneError(f"yield: {100 * share:g} % is not between 0 and 100 %; give one such as 90")
        return self._begin(name, "tolerance", {"grade": asked.get("grade") or None, "yield": share})

    def tradeoff(self, name: str, asked: Asked) -> dict[str, Any]:
        """The price of accuracy in time: {budget in seconds}."""
        budget = _number(asked.get("budget") or 600, "budget")
        if not 1 <= budget <= 86_400:
            raise SceneError(f"budget: {budget:g} s is not between 1 s and a day; give seconds, such as 600")
        self.workspace.design(f"{name}-tradeoff")  # where its files go
        return self._begin(name, "tradeoff", {"budget": budget})

    async def measured(self, request: Request) -> Response:
        """Judge a made part by its measured points, the body of the request."""
        data, name = await request.body(), request.path_params["name"]
        ending = next((ending for start, ending in CLOUDS if data[:80].lstrip().lower().startswith(start)), ".csv")
        if ending == ".csv" and b"\0" in data[:200]:
            ending = ".stl"  # a binary one
        contents = {f"cloud{ending}": data}
        return JSONResponse(await run_in_threadpool(self._begin, name, "measured", contents=contents))

    def _begin(
        self, name: str, kind: str, job: Asked | None = None, contents: Mapping[str, bytes] | None = None
    ) -> dict[str, Any]:  # fmt: skip
        run = Run(self.workspace.design(name), kind)
        self.workspace.file(name, "lens.step")
        run.begin(job, contents)
        self.started.append(run)
        return {}

    # ---- files ----

    def one_file(self, request: Request) -> Response:
        """A file of a design: its pages and pictures to look at, others to keep."""
        path = self.workspace.file(request.path_params["name"], request.path_params["path"])
        kind = SHOWN.get(path.suffix)
        if kind is None or "download" in request.query_params:
            return FileResponse(path, media_type="application/octet-stream", filename=path.name)
        policy = SANDBOX if kind == "text/html" else POLICY  # a folder may come from elsewhere: its page has no origin
        return FileResponse(path, media_type=kind, headers={"Content-Security-Policy": policy})

    def all_files(self, request: Request) -> Response:
        """All files of a design as a ZIP archive, written while it is sent."""
        name = request.path_params["name"]
        paths = [(each, self.workspace.file(name, each)) for each in self.workspace.file_names(name)]
        if not paths:
            raise SceneError(f"{name}: has no files yet; wait for the end of its design")
        headers = {"Content-Disposition": f'attachment; filename="{name}.zip"'}
        return StreamingResponse(_zipped(name, paths), media_type="application/zip", headers=headers)


class _Site(StaticFiles):
    """The documentation, whose pages have scripts and styles of their own."""

    async def get_response(self, path: str, scope: Any) -> Response:
        answer = await super().get_response(path, scope)
        answer.headers["Content-Security-Policy"] = (
            "default-src 'self' 'unsafe-inline' data:; object-src 'none'; base-uri 'none'; frame-ancestors 'none'"
        )
        return answer


def _of_json(work: Callable[[str, Asked], dict[str, Any]]) -> Callable[[Request], Awaitable[Response]]:
    """Answer requests by work(name in the address, table of JSON in the body), which is done in a thread."""

    async def answer(request: Request) -> Response:
        try:
            asked = json.loads(await request.body() or b"{}")
        except (ValueError, RecursionError):
            asked = None
        if not isinstance(asked, dict):
            raise SceneError("the request is no table of JSON; reload the page")
        return JSONResponse(await run_in_threadpool(work, request.path_params.get("name", ""), asked))

    return answer


def _given(table: Asked, name: str) -> Any:
    """What a request states.  SceneError."""
    if name not in table:
        raise SceneError(f"{name}: is missing in the request; reload the page")
    return table[name]


def _whole(given: Any) -> int:
    """A whole number of a request.  SceneError."""
    try:
        return int(given)
    except (ValueError, TypeError, OverflowError):
        raise SceneError(f"{str(given)[:40]!r}: is no whole number; reload the page") from None


def _number(given: Any, key: str) -> float:
    """A number that a person typed.  SceneError."""
    try:
        return float(given)
    except (ValueError, TypeError, OverflowError):
        raise SceneError(f"{key}: {str(given)[:40]!r} is not a number; write one") from None


def _zipped(name: str, paths: list[tuple[str, Path]]) -> Iterator[bytes]:
    """A ZIP archive of files in a folder of that name, piece by piece."""
    written = _Written()
    with zipfile.ZipFile(written, "w", zipfile.ZIP_DEFLATED) as archive:
        for each, path in paths:
            with path.open("rb") as source, archive.open(f"{name}/{each}", "w", force_zip64=True) as target:
                while piece := source.read(1 << 20):
                    target.write(piece)
                    yield bytes(written)
                    written.clear()
    yield bytes(written)


class _Written(bytearray):
    """Bytes that a ZIP archive has written and that are yet to be sent."""

    def write(self, data: bytes) -> int:
        self.extend(data)
        return len(data)

    def flush(self) -> None: ...


def _flat(table: Mapping[str, Any], at: str = "") -> dict[str, str]:
    """The values of a scene by dotted key, as text."""
    found: dict[str, str] = {}
    for name, value in table.items():
        key = f"{at}.{name}".lstrip(".")
        if isinstance(value, dict):
            found |= _flat(value, key)
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            found |= {k: v for i, part in enumerate(value) for k, v in _flat(part, f"{key}[{i}]").items()}
        else:
            found[key] = json.dumps(value, ensure_ascii=False)
    return found


def serve(given: Path | None, port: int, say: Callable[[str], None], show: Callable[[str], Any]) -> None:
    """Serve the workbench until a Ctrl-C.  say: called with sentences for the terminal; show: with the address."""
    workspace, page = Workspace.of(given)
    with bound(port) as own:
        number, token = own.getsockname()[1], secrets.token_urlsafe(24)
        workbench = Workbench(workspace)
        guarded = Guard(workbench.app, number, token, larger=(LARGER, LARGEST_UPLOAD))
        address = f"http://127.0.0.1:{number}{page}?token={token}"
        say(f"Workbench: {address}")
        say("It is for this machine alone; Ctrl-C ends it, and designs under way can be gone on with.")
        try:
            show(address)
            with contextlib.suppress(KeyboardInterrupt):
                uvicorn_server(guarded, workbench.desk.close).run(sockets=[own])
        finally:
            for sentence in workbench.end():
                say(sentence)
