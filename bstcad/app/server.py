"""The server of the workbench on loopback, which sends the pages and answers the requests of their scripts.

guard.py checks each request first.  Nothing is lost when the server ends: scenes, runs and designs are in files.
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
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.staticfiles import StaticFiles

import bstcad
from bstcad.app import crop, design_runs, dome_offer, form, preview_json, scene_text, sketch
from bstcad.app.connections import bound, uvicorn_server
from bstcad.app.design_process import STUDIES
from bstcad.app.design_runs import SCENE_TEXT, Run
from bstcad.app.followers import impossible_choices, take_change
from bstcad.app.guard import POLICY, SANDBOX, Guard, TooLarge
from bstcad.app.preview_desk import STAGES, PreviewDesk, PreviewRequest
from bstcad.app.workspace import LARGEST_UPLOAD, Workspace
from bstcad.designs import folder as folders
from bstcad.figures.light_figures import View, dark_triptych
from bstcad.manufacture.tolerance.lit_by import LIGHTS
from bstcad.planning.preview import Preview
from bstcad.report import manual, record
from bstcad.report.report import VIEWER, cell_sentences, counts, doubts, first_figures
from bstcad.runs import files
from bstcad.runs.files import SentenceError
from bstcad.scene import new_scene, scene_file
from bstcad.scene.errors import SceneError, line_of, toml_positions
from bstcad.scene.picture import SAMPLES
from bstcad.scene.quality import GRADE_NAMES
from bstcad.scene.scene_file import MAX_DOTS
from bstcad.scene.schema import rows

Body = Mapping[str, Any]  # JSON object that a page sends
ANSWER_TIMEOUT = 20.0  # time (s) until a waiting request returns without an answer and the page polls again
UPLOAD = "/api/picture"  # address to which a page sends a picture
LARGE_BODY_PATHS = rf"{UPLOAD}|/api/design/[^/]+/(measured|compensate)"  # their bodies may have LARGEST_UPLOAD bytes
STATIC = Path(__file__).parent / "static"  # folder of scripts and styles
# Content types, by file ending, of the files of a design that a page shows; all other files are downloads.
CONTENT_TYPES = {".html": "text/html", ".json": "application/json", ".png": "image/png", ".pdf": "application/pdf"}
RRMSD = (
    "RRMSD is the error of the light: the root mean square of its difference from the picture, divided by the root "
    "mean square of the picture, on pixels unless other cells are named. 0 would be the exact picture; lenses in "
    "publications have 0.1 to 0.4."
)
KEYS_PAGE = "reference/scene-keys"  # page of the documentation that is generated from the schema
MAX_VALID_TEXTS = 31  # largest number of scenes, besides the current one, whose latest valid text is stored
# Files at the top of the list of a design's files.
SHOP_FILES = {  # kinds of `bstcad export` on the page of a design, and their names
    "raster": "tool path for a router (G-code)", "spiral": "tool path for a lathe (C, X, Z)",
    "heightmap": "height map (picture)", "tiles": "tiles for a smaller machine (STEP)",
}  # fmt: skip
FIRST_FILES = ("lens.step", "part.step", "report.html", "datasheet.pdf", "lens.stl", "lens.3mf")
CLOUD_ENDINGS = (  # (offset of the first bytes of a file of measured points, these bytes in lower case, file ending)
    (0, b"ply", ".ply"), (0, b"solid", ".stl"), (0, b"pk\x03\x04", ".x3p"), (1, b"iso-", ".sdf"), (1, b"bcr-", ".sdf"),
    (1, b"hdf\r\n", ".datx"), (0, b"vca data", ".opdx"), (2, b"directory", ".opd"), (0, b"digital surf", ".sur"),
)  # fmt: skip


class Workbench:
    """Web application of the server, with the previews and runs that the server has started."""

    def __init__(self, workspace: Workspace) -> None:
        self.workspace, self.desk = workspace, PreviewDesk()
        self.started: list[Run] = []  # runs that this server has started
        self._valid_texts: dict[str, str] = {}  # latest valid text, by scene; see `take_change`
        scene, design = "/api/scene/{name}", "/api/design/{name}"
        get_routes = {
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
        post_routes = {
            UPLOAD: self.keep_picture,
            f"{scene}/drop": self.drop_changes,
            f"{design}/stop": self.stop,
            f"{design}/go-on": self.go_on,
            f"{design}/measured": partial(self.measured, kind="measured"),
            f"{design}/compensate": partial(self.measured, kind="compensate"),
            "/api/scenes": _json_handler(self.add_scene),
            f"{scene}/change": _json_handler(self.change_scene),
            f"{scene}/proportions": _json_handler(self.take_proportions),
            f"{scene}/save": _json_handler(self.save_scene),
            f"{scene}/preview": _json_handler(self.preview),
            f"{scene}/make": _json_handler(self.make),
            f"{design}/tolerance": _json_handler(self.tolerance),
            f"{design}/tradeoff": _json_handler(self.tradeoff),
            f"{design}/retailor": _json_handler(self.retailor),
            f"{design}/export": _json_handler(self.export),
            f"{design}/edit": _json_handler(self.edit),
        }
        routes = [Route(path, answer) for path, answer in get_routes.items()]
        routes += [Route(path, answer, methods=["POST"]) for path, answer in post_routes.items()]
        handlers = {SentenceError: self._refuse, OSError: self._refuse_file, ClientDisconnect: self._note_disconnect}
        handlers |= {TooLarge: lambda request, error: Response(status_code=413)}  # the guard says so in its own words
        handlers |= {Exception: self._report_fault, 404: self._no_page}
        self.app = Starlette(routes=routes, exception_handlers=handlers)
        self.app.mount("/static", StaticFiles(directory=STATIC))
        site = manual.site()
        self.has_docs = site is not None or manual.FIRST in manual.pages()
        if site is not None:
            self.app.mount("/docs", _Site(directory=site, html=True))
        elif self.has_docs:
            self.app.router.routes.append(Route("/docs/{page:path}", self.manual_page))

    def end(self) -> list[str]:
        """End the previews and the runs of this server; return a sentence on each run that was still running."""
        running = design_runs.end(self.started)
        self.desk.end()
        return design_runs.endings(running)

    def _refuse(self, request: Request, error: Exception) -> Response:
        return self._sentence_answer(request, str(error), 400)

    def _refuse_file(self, request: Request, error: Exception) -> Response:
        assert isinstance(error, OSError)
        name = f"{Path(error.filename).name}: " if isinstance(error.filename, str) else ""
        remedy = "check the permissions of the file and the free space on the disk"
        return self._sentence_answer(request, f"{name}{error.strerror or type(error).__name__}; {remedy}", 400)

    def _note_disconnect(self, request: Request, error: Exception) -> Response:
        print(f"bstcad: {request.url.path}: the browser cancelled this request; nothing was done", file=sys.stderr)
        return Response(status_code=400)

    def _report_fault(self, request: Request, error: Exception) -> Response:
        traceback.print_exception(error)
        words = f"{type(error).__name__}: {files.first_line(error)}"
        return self._sentence_answer(request, f"{words}; see the terminal of the workbench for the traceback", 500)

    def _sentence_answer(self, request: Request, sentence: str, status: int) -> Response:
        """Answer with a sentence, as JSON under /api/ or else as a page; folders of this machine are left out of it."""
        sentence = self.workspace.without_paths(sentence)
        if not request.url.path.startswith("/api/"):
            return self._page("lost.html.j2", status=status, title="Error", sentence=sentence)
        return JSONResponse({"sentence": sentence}, status_code=status)

    def _no_page(self, request: Request, error: Exception) -> Response:
        return self._page("lost.html.j2", status=404, title="No such page", sentence="")

    def manual_page(self, request: Request) -> Response:
        """Answer with a page of the documentation as Markdown, if the HTML pages are not built."""
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
        common |= {"grades": GRADE_NAMES, "lights": LIGHTS}
        return HTMLResponse(form.environment().get_template(template).render(**common, **values), status_code=status)

    # ---- pages ----

    def start_page(self, request: Request) -> Response:
        """Answer with the start page: the field for a picture, and the lists of scenes and designs."""
        lists = {"scenes": self.workspace.scene_names(), "designs": [*self._designs()]}
        templates = new_scene.templates()
        return self._page("start.html.j2", title="Workbench", samples=SAMPLES, templates=templates, **lists)

    def _designs(self) -> Iterator[dict[str, Any]]:
        running = {run.design.name: run for run in design_runs.all_runs(self.workspace.designs) if run.kind == "design"}
        finished = self.workspace.design_names()
        for name in [*(name for name in running if name not in finished), *finished]:
            run, known = running.get(name), self._report(name) if name in finished else None
            state = run.state.state if run is not None else "none"
            title, verdict, rrmsd = (known.title, known.verdict, record.rrmsds(known)) if known else ("", "", "")
            yield {"name": name, "title": title, "verdict": verdict, "rrmsd": rrmsd, "state": state} | {
                "picture": self._thumbnail(name, run)
            }

    def _thumbnail(self, name: str, run: Run | None) -> str:
        if (self.workspace.design(name) / "figures" / "irradiance.png").is_file():
            return f"/design/{name}/files/figures/irradiance.png"
        return f"/api/design/{name}/light.png" if run is not None and run.light else ""

    def _report(self, name: str) -> record.Contents | None:
        try:
            return record.read(self.workspace.file(name, "report.json"))
        except ValueError:
            return None

    def scene_page(self, request: Request) -> Response:
        """Answer with the page on which a scene is edited with its preview."""
        opened = self.workspace.opened(request.path_params["name"])
        return self._page("scene.html.j2", title=opened.name, name=opened.name, state=self._state(opened.name))

    def design_page(self, request: Request) -> Response:
        """Answer with the page of a running or finished design."""
        name = request.path_params["name"]
        folder, run = self.workspace.design(name), Run(self.workspace.design(name))
        known = self._report(name)
        if known is None and run.state.state == "none":
            raise SceneError(f"{name}: there is no such design; choose one from the list")
        names = self.workspace.file_names(name) if folder.is_dir() else []
        names.sort(key=lambda each: FIRST_FILES.index(each) if each in FIRST_FILES else len(FIRST_FILES))
        result = {"rrmsd": record.rrmsds(known) if known else "", "doubts": doubts(known) if known else ()}
        result |= {"report": known, "files": names, "has_light": "figures/irradiance.png" in names}
        result["counts"] = counts(known.checks) if known else ""
        result["figures"] = first_figures(known) if known else []
        result["copy_title"] = known.title if known else ""
        measured = [goal for goal in known.goals if goal.on_cells(0.5)] if known else []
        result["by_cell"] = [sentence for goal in measured for sentence in cell_sentences(goal)]
        jobs = {kind: self._news(Run(folder, kind)) for kind in STUDIES}
        result["shop_files"] = SHOP_FILES
        return self._page("design.html.j2", title=name, name=name, run=self._news(run), jobs=jobs, **result)

    def compare_page(self, request: Request) -> Response:
        """Answer with the page that compares up to four designs: pictures, RRMSD over time, and keys that differ."""
        names = [name for name in request.query_params.getlist("design")][:4]
        known = [(name, self._report(name)) for name in names]
        found = [{"name": name, "report": report, "rrmsd": record.rrmsds(report)} for name, report in known if report]
        flat = [_flat_values(scene_file.read(self.workspace.file(each["name"], "scene.toml"))[1]) for each in found]
        keys = sorted({key for each in flat for key in each})
        rows = [(key, [each.get(key, "") for each in flat]) for key in keys if len({e.get(key) for e in flat}) > 1]
        curves = [[[point.seconds, point.rrmsd] for point in each["report"].history] for each in found]
        return self._page("compare.html.j2", title="Comparison", designs=found, rows=rows, curves=json.dumps(curves))

    # ---- scenes ----

    def add_scene(self, _: str, body: Body) -> dict[str, Any]:
        """Write a scene file; body: {light, size} as in `bstcad new`, or {template}; and picture, sample or text."""
        known = {key: str(body[key]) for key in ("sample", "text", "template") if body.get(key)}
        image = str(body["picture"]) if body.get("picture") else None
        light = str(body.get("light") or next(iter(new_scene.LIGHTS)))
        size = str(body["size"])[:40] if body.get("size") and "template" not in known else None
        return {"name": self.workspace.add(light, image=image, size=size, **known)}

    async def keep_picture(self, request: Request) -> Response:
        """Store an uploaded picture, the body of the request, and answer with its name."""
        data = await request.body()
        return JSONResponse({"picture": await run_in_threadpool(self.workspace.keep, data)})

    def scene_state(self, request: Request) -> Response:
        """Answer with a scene's text, form and fault, or only with its revision if the page has it (?revision)."""
        known, name = request.query_params.get("revision"), request.path_params["name"]
        if known is not None and known == self.workspace.opened(name).revision:
            return JSONResponse({"revision": known})
        return JSONResponse(self._state(name))

    def _state(self, name: str) -> dict[str, Any]:
        opened = self.workspace.opened(name)
        answer = {"name": name, "text": opened.text, "revision": opened.revision, "saved": opened.saved}
        try:
            data = scene_text.tables(opened.text)
        except SceneError as fault:
            at = re.search(r"at line (\d+)", str(fault))
            error = {"key": "", "sentence": str(fault), "line": int(at[1]) if at else None}
            return answer | {"form": None, "error": error}
        error = self._fault(name, opened.text)
        if error is None:
            self._valid_texts = {**dict([*self._valid_texts.items()][-MAX_VALID_TEXTS:]), name: opened.text}
        fields = form.form(data)
        answer["design"] = data.get("name") if isinstance(data.get("name"), str) else name
        errors = {error["key"]: error["sentence"]} if error else {}
        page = form.html(fields, errors, self.has_docs)
        return answer | {"form": page, "error": error, "sketch": sketch.svg(data)}

    def _fault(self, name: str, text: str) -> dict[str, Any] | None:
        """Return the fault of a scene's text: its key, sentence and line; None for a valid scene."""
        try:
            self.workspace.scene(name, text)
        except SentenceError as fault:
            sentence = self.workspace.without_paths(str(fault))
            key = sentence.partition(":")[0]
            return {"key": key, "sentence": sentence, "line": line_of(key, toml_positions(text))}
        return None

    def change_scene(self, name: str, body: Body) -> dict[str, Any]:
        """Change a scene; body: {text}, or {key, words} with words that a person typed, or {key, value}.

        {locked: true}: the other side of a target or an outline keeps its ratio to the changed side.  In the answer,
        `followed` lists the other keys that changed.
        """
        followed: list[str] = []

        def is_valid(text: str) -> bool:
            return self._fault(name, text) is None

        def with_value(text: str) -> str:
            key, data = str(_required(body, "key")), scene_text.tables(text)
            if key.count(".") > MAX_DOTS:
                raise SceneError(f"{key[:20]}…: is not a key of a scene; reload the page")
            value = body["value"] if "value" in body else scene_text.typed(key, str(_required(body, "words")), data)
            valid, locked = self._valid_texts.get(name), body.get("locked") is True
            text, others = take_change(text, key, value, is_valid=is_valid, valid_text=valid, locked=locked)
            followed.extend(others)
            return text

        if "text" in body:
            self.workspace.change(name, str(body["text"]).replace("\r\n", "\n"))
        else:
            self.workspace.edit(name, with_value)
        return self._state(name) | {"followed": followed}

    def photo(self, request: Request) -> Response:
        """Answer with a small copy of the whole photo of the target ?key, on which the page draws the crop."""
        name, key = request.path_params["name"], request.query_params.get("key", "target")
        scene = self.workspace.scene(name, self.workspace.opened(name).text)
        return Response(crop.small_photo(crop.target_of(scene, key)), media_type="image/png")

    def take_proportions(self, name: str, body: Body) -> dict[str, Any]:
        """Give lens and picture the proportions of a target's photo; body: {key}, the key of the target."""
        key = str(body.get("key") or "target")

        def with_proportions(text: str) -> str:
            target = crop.target_of(self.workspace.scene(name, text), key)
            for other, value in crop.in_proportions(scene_text.tables(text), key, target).items():
                text = scene_text.changed(text, other, value)
            return text

        self.workspace.edit(name, with_proportions)
        return self._state(name)

    def impossible_choices(self, request: Request) -> Response:
        """Answer with the choices of the form that this scene cannot have: {key: {choice: reason}}."""
        name = request.path_params["name"]
        text = self.workspace.opened(name).text
        return JSONResponse(impossible_choices(text, lambda each: (self._fault(name, each) or {}).get("sentence")))

    def save_scene(self, name: str, body: Body) -> dict[str, Any]:
        """Save the text in the scene file; body: {anyway: true} replaces a file that another program changed."""
        self.workspace.save(name, anyway=bool(body.get("anyway")))
        return self._state(name)

    def drop_changes(self, request: Request) -> Response:
        """Discard the unsaved changes."""
        self.workspace.drop(request.path_params["name"])
        return JSONResponse(self._state(request.path_params["name"]))

    # ---- previews ----

    def preview(self, name: str, body: Body) -> dict[str, Any]:
        """Request previews of a scene and answer as `answer` does for the first stage.

        body: {page, number, made, lit}; made: grade of the picture as made, lit: another light, or absent.
        """
        text = self.workspace.opened(name).text
        page, number = str(_required(body, "page"))[:40], _integer(_required(body, "number"))
        grade = str(body["made"]) if body.get("made") in GRADE_NAMES else None
        light = str(body["lit"]) if isinstance(body.get("lit"), str) and body["lit"] in LIGHTS else None
        asking = PreviewRequest(page, number, self.workspace.scene(name, text), text=text, grade=grade, light=light)
        self.desk.ask(asking)
        return self._answered(name, asking, 0)

    def answer(self, request: Request) -> Response:
        """Answer with the result of a stage (?page, number, stage); {}: not finished; {replaced: true}: outdated."""
        query = request.query_params
        number, stage = _integer(_required(query, "number")), _integer(_required(query, "stage"))
        body = self.desk.last(_required(query, "page"))
        if body is None or body.number != number or not 0 <= stage < len(STAGES):
            return JSONResponse({"replaced": True})
        return JSONResponse(self._answered(request.path_params["name"], body, stage))

    def _answered(self, scene: str, body: PreviewRequest, stage: int) -> dict[str, Any]:
        answer = self.desk.answer(body, stage, ANSWER_TIMEOUT)
        if answer is None:
            return {"replaced": True} if body.replaced else {}
        name, found = answer
        head = {"stage": name, "number": body.number}
        if isinstance(found, SentenceError):
            return head | {"refused": self.workspace.without_paths(str(found))}
        if isinstance(found, Exception):
            why = self.workspace.without_paths(files.first_line(found))
            return head | {"refused": f"the computation failed ({why}); a design may still succeed"}
        if name in ("preview", "settled"):
            return head | preview_json.of_preview(found) | {"offer": self._offer(scene, body.text, found)}
        if name == "made":
            return head | {"made": None if found is None else preview_json.of_made(*found)}
        return head | (preview_json.of_plan(found) if name == "effects" else preview_json.of_predictions(found))

    def _offer(self, name: str, text: str, found: Preview) -> dict[str, Any] | None:
        """Return the offer of a dome in place of the lens of a preview; None without an offer."""

        def fault(each: str) -> str | None:
            return (self._fault(name, each) or {}).get("sentence")

        if found.scene.lens.dome is not None or found.scene.source.parallel:
            return None
        changed, _ = take_change(text, dome_offer.BACK_KIND, dome_offer.DOME, is_valid=lambda each: fault(each) is None)
        made = dome_offer.offer(found, scene_text.tables(changed), fault(changed))
        return None if made is None else asdict(made)

    # ---- designs ----

    def make(self, name: str, body: Body) -> dict[str, Any]:
        """Save the scene and start its design in its own process; answer with the design's name.

        body: {page}, the id of the page; its request for previews is dropped.
        """
        self.desk.drop(str(body.get("page")))
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
            raise SceneError(f"{kind}: is not a kind of run; choose one of {', '.join(design_runs.JOBS)}")
        return Run(self.workspace.design(request.path_params["name"]), kind)

    def follow(self, request: Request) -> Response:
        """Answer with the state of a run (?kind) and the lines of its progress from number ?since on."""
        return JSONResponse(self._news(self._run(request), _integer(request.query_params.get("since", 0))))

    def _news(self, run: Run, since: int = 10**9) -> dict[str, Any]:
        """Return state and progress (from line `since` on) of a run, without the folders of this machine."""
        news = run.news(since)
        news["sentence"] = self.workspace.without_paths(news["sentence"])
        for line in news["lines"]:
            line[4] = self.workspace.without_paths(line[4])
        return news

    def light(self, request: Request) -> Response:
        """Answer with the picture of the light through the best lens so far."""
        data = Run(self.workspace.design(request.path_params["name"])).light
        return Response(data, media_type="image/png") if data else Response(status_code=404)

    def dark_figure(self, request: Request) -> Response:
        """Answer with irradiance.png drawn for dark mode, or with the file itself if the design cannot be read."""
        name = request.path_params["name"]
        usual = self.workspace.file(name, "figures/irradiance.png")
        try:
            folder = self.workspace.file(name, "design.npz").parent
            nominal = folders.read_nominal(folder)
            found = nominal.goals[0].picture, folders.read_irradiances(folder, nominal.scene)[0]
            return Response(dark_triptych(*found, View.of(nominal.scene)), media_type="image/png")
        except SentenceError:
            return FileResponse(usual, media_type="image/png")

    def stop(self, request: Request) -> Response:
        """Stop a run; a design ends with the best lens so far, or at once with a checkpoint (?at_once)."""
        run = self._run(request)
        gently = run.kind == design_runs.DESIGN and "at_once" not in request.query_params
        run.signal(signal.SIGINT if gently else signal.SIGTERM)
        return JSONResponse({})

    def go_on(self, request: Request) -> Response:
        """Resume a run that was stopped or killed."""
        run = self._run(request)
        run.go_on()
        self.started.append(run)
        return JSONResponse({})

    def edit(self, name: str, body: Body) -> dict[str, Any]:
        """Write the scene of a design as a new scene, and answer with its name; body: {"title": text}, optional."""
        folder = self.workspace.design(name)
        source = folder if (folder / "scene.toml").is_file() else Run(folder).folder
        title = None if body.get("title") is None else str(body["title"])
        return {"name": self.workspace.adopt(name, source, Run(folder).folder / SCENE_TEXT, title=title)}

    def tolerance(self, name: str, body: Body) -> dict[str, Any]:
        """Start a study of tolerances; body: {"grade": name, "yield": percent}, both optional."""
        wanted = body.get("yield")
        fraction = None if wanted in (None, "") else _number(wanted, "yield") / 100
        if fraction is not None and not 0 < fraction < 1:
            raise SceneError(f"yield: {100 * fraction:g} % is not strictly between 0 and 100 %; give 90, for example")
        return self._begin(name, "tolerance", {"grade": body.get("grade") or None, "yield": fraction})

    def tradeoff(self, name: str, body: Body) -> dict[str, Any]:
        """Start a study of time against accuracy; body: {"budget": seconds}."""
        budget = _number(body.get("budget") or 600, "budget")
        if not 1 <= budget <= 86_400:
            raise SceneError(f"budget: {budget:g} s is not between 1 s and one day; give a time in s, such as 600")
        self.workspace.design(f"{name}-tradeoff")  # raises if the folder of the result lies outside
        return self._begin(name, "tradeoff", {"budget": budget})

    def export(self, name: str, body: Body) -> dict[str, Any]:
        """Start to write files for a shop; body: {"kind": name, "tool_radius": mm, "tiles": "2x3"}, kind required."""
        kind, radius, tiles = (body.get(key) for key in ("kind", "tool_radius", "tiles"))
        if not isinstance(kind, str) or kind not in SHOP_FILES:
            raise SceneError(f"kind: {kind!r} is no file for a shop; give {', '.join(SHOP_FILES)}")
        size = None if radius in (None, "") else _number(radius, "tool_radius")
        return self._begin(name, "export", {"kind": kind, "tool_radius": size, "tiles": str(tiles or "")[:20]})

    def retailor(self, name: str, body: Body) -> dict[str, Any]:
        """Start to tailor the back anew; body: {"thickness": mm, "index": number}, one of which may be empty."""
        given = {key: body.get(key) for key in ("thickness", "index")}
        values = {key: None if value in (None, "") else _number(value, key) for key, value in given.items()}
        if not any(values.values()):
            raise SceneError("thickness: is empty, and so is index; give what was measured of the blank")
        self.workspace.design(f"{name}-as-built")  # raises if the folder of the result lies outside
        return self._begin(name, "retailor", values)

    async def measured(self, request: Request, kind: str) -> Response:
        """Judge a made part, or compute what to cut next, by its measured points, the body of the request."""
        data, name = await request.body(), request.path_params["name"]
        head = data[:80].lstrip().lower()
        ending = next((ending for offset, first, ending in CLOUD_ENDINGS if head.startswith(first, offset)), ".csv")
        if ending == ".csv" and b"\0" in data[:200]:
            ending = ".stl"  # binary STL
        contents = {f"cloud{ending}": data}
        return JSONResponse(await run_in_threadpool(self._begin, name, kind, contents=contents))

    def _begin(
        self, name: str, kind: str, job: Body | None = None, contents: Mapping[str, bytes] | None = None
    ) -> dict[str, Any]:
        run = Run(self.workspace.design(name), kind)
        self.workspace.file(name, "lens.step")
        run.begin(job, contents)
        self.started.append(run)
        return {}

    # ---- files ----

    def one_file(self, request: Request) -> Response:
        """Answer with a file of a design: pages and pictures to be shown, other files as downloads."""
        path = self.workspace.file(request.path_params["name"], request.path_params["path"])
        kind = CONTENT_TYPES.get(path.suffix)
        if kind is None or "download" in request.query_params:
            return FileResponse(path, media_type="application/octet-stream", filename=path.name)
        policy = SANDBOX if kind == "text/html" else POLICY  # a page may come from elsewhere: isolate it
        return FileResponse(path, media_type=kind, headers={"Content-Security-Policy": policy})

    def all_files(self, request: Request) -> Response:
        """Answer with all files of a design as a ZIP archive, which is written while it is sent."""
        name = request.path_params["name"]
        paths = [(each, self.workspace.file(name, each)) for each in self.workspace.file_names(name)]
        if not paths:
            raise SceneError(f"{name}: has no files yet; wait until the design ends")
        headers = {"Content-Disposition": f'attachment; filename="{name}.zip"'}
        return StreamingResponse(_zip_parts(name, paths), media_type="application/zip", headers=headers)


class _Site(StaticFiles):
    """Static pages of the documentation, with a policy that allows their own scripts and styles."""

    async def get_response(self, path: str, scope: Any) -> Response:
        answer = await super().get_response(path, scope)
        answer.headers["Content-Security-Policy"] = (
            "default-src 'self' 'unsafe-inline' data:; object-src 'none'; base-uri 'none'; frame-ancestors 'none'"
        )
        return answer


def _json_handler(work: Callable[[str, Body], dict[str, Any]]) -> Callable[[Request], Awaitable[Response]]:
    """Return a handler that calls work(name in the address, JSON object in the body) in a thread."""

    async def answer(request: Request) -> Response:
        try:
            body = json.loads(await request.body() or b"{}")
            json.dumps(body, ensure_ascii=False).encode()  # UnicodeEncodeError: half of a character, such as \ud800
        except (ValueError, RecursionError):
            body = None
        if not isinstance(body, dict):
            raise SceneError("the request is not a JSON object of valid text; reload the page")
        return JSONResponse(await run_in_threadpool(work, request.path_params.get("name", ""), body))

    return answer


def _required(table: Body, name: str) -> Any:
    if name not in table:
        raise SceneError(f"{name}: is missing from the request; reload the page")
    return table[name]


def _integer(given: Any) -> int:
    try:
        return int(given)
    except (ValueError, TypeError, OverflowError):
        raise SceneError(f"{str(given)[:40]!r}: is not a whole number; reload the page") from None


def _number(given: Any, key: str) -> float:
    try:
        return float(given)
    except (ValueError, TypeError, OverflowError):
        raise SceneError(f"{key}: {str(given)[:40]!r} is not a number; write a number") from None


def _zip_parts(name: str, paths: list[tuple[str, Path]]) -> Iterator[bytes]:
    """Yield the parts of a ZIP archive with a folder `name`; paths: (name in this folder, file) of each file."""
    written = _ZipBuffer()
    with zipfile.ZipFile(written, "w", zipfile.ZIP_DEFLATED) as archive:
        for each, path in paths:
            with path.open("rb") as source, archive.open(f"{name}/{each}", "w", force_zip64=True) as target:
                while piece := source.read(1 << 20):
                    target.write(piece)
                    yield bytes(written)
                    written.clear()
    yield bytes(written)


class _ZipBuffer(bytearray):
    """Bytes of a ZIP archive that are written but not yet sent."""

    def write(self, data: bytes) -> int:
        self.extend(data)
        return len(data)

    def flush(self) -> None: ...


def _flat_values(table: Mapping[str, Any], at: str = "") -> dict[str, str]:
    found: dict[str, str] = {}
    for name, value in table.items():
        key = f"{at}.{name}".lstrip(".")
        if isinstance(value, dict):
            found |= _flat_values(value, key)
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            found |= {k: v for i, part in enumerate(value) for k, v in _flat_values(part, f"{key}[{i}]").items()}
        else:
            found[key] = json.dumps(value, ensure_ascii=False)
    return found


def serve(given: Path | None, port: int, say: Callable[[str], None], show: Callable[[str], Any]) -> None:
    """Serve the workbench until Ctrl-C.  given: see `Workspace.of`.  say: prints a sentence; show: opens an address."""
    workspace, page = Workspace.of(given)
    with bound(port) as own:
        number, token = own.getsockname()[1], secrets.token_urlsafe(24)
        workbench = Workbench(workspace)
        guarded = Guard(workbench.app, number, token, larger=(LARGE_BODY_PATHS, LARGEST_UPLOAD))
        address = f"http://127.0.0.1:{number}{page}?token={token}"
        say(f"Workbench: {address}")
        say("Only this machine can open it. Ctrl-C ends it; running designs can be resumed later.")
        try:
            show(address)
            with contextlib.suppress(KeyboardInterrupt):
                uvicorn_server(guarded, workbench.desk.close).run(sockets=[own])
        finally:
            for sentence in workbench.end():
                say(sentence)
