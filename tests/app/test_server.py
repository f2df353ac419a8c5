"""No name leads out of the folders, no answer tells where they are, no request breaks the server, no change is lost."""

import io
import json
import os
import re
import shutil
import time
import zipfile
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest
from PIL import Image

from bstcad.app import design_process, scene_text, server
from bstcad.app.design_process import State
from bstcad.app.design_runs import Run
from bstcad.app.workspace import Workspace
from tests import suite
from tests.app.asking import MB, bench, made, png, routes, tree
from tests.app.conftest import SMALL

SECRET = "secret-of-another-folder"
READS_JSON = (
    "/api/scenes", "/api/scene/small/change", "/api/scene/small/save", "/api/scene/small/preview",
    "/api/design/made/tolerance", "/api/design/made/tradeoff",
)  # fmt: skip


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A workbench with a scene, a design, and much that is none of its business beside them; no process begins."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr(Run, "_start", lambda self, *options: State("finished").put(self.folder))
    (tmp_path / "secret.txt").write_text(SECRET)
    (tmp_path / "secret.toml").write_text(SMALL.replace("An evenly", SECRET).replace('"small"', f'"{SECRET}"'))
    (tmp_path / "secret.png").write_bytes(png(8, 8).replace(b"IEND", SECRET.encode()))
    (tmp_path / "home").mkdir()
    found = bench(tmp_path / "home/lenses", monkeypatch)
    found.files = made(found.folder / "made")
    found.outside = tmp_path
    return found


# ---- paths -----------------------------------------------------------------------------------------------------------

UP = [
    "..", "../secret", "..%2fsecret.txt", "%2e%2e/secret", "..%5csecret", "..%252fsecret.txt", "small%00", "a/b",
    "made%0a", ".small.toml.unsaved", ".made.design-run", "-r", "~", "*", "small%ff", "x" * 5000, "made/../../secret",
    "{outside}/secret", "%2f{outside}/secret.txt", "file:{outside}/secret.txt",
]  # fmt: skip


def filled(path, name, place="lens.step"):
    """A route's path with its parameters."""
    return path.replace("{name}", name).replace("{path:path}", place)


def tells(own, answer, up):
    """Does an answer tell more of the folders than the request that it quotes?"""
    return str(own.outside) in answer.text.replace(up, "").replace(unquote(up), "")


@pytest.mark.parametrize("up", UP)
def test_no_name_leads_out_of_the_folders(own, up):
    """Any route and any name: no file outside the folders is sent or written."""
    up, before = up.replace("{outside}", str(own.outside)), tree(own.outside)
    asked = [(path, method) for path, method in routes(own.workbench) if "{name}" in path]
    assert len(asked) > 20
    for path, method in asked:
        body = {"page": "p", "number": 1, "text": "x"} if method == "POST" else b""
        answer = own.ask(f"{filled(path, up)}?page=p&number=1&stage=0", body, method)
        known = (200,) if path.endswith("/answer") else ()  # which is of a page, whatever its scene
        assert answer.status in (400, 404, 405, *known) and answer.error is None, (path, answer.status, answer.error)
        assert SECRET not in answer.text and not tells(own, answer, up), path
    assert tree(own.outside) == before


@pytest.mark.parametrize(
    "path",
    [
        "/static/../server.py", "/static/%2e%2e/server.py", "/static/..%2fserver.py", "/static//etc/passwd",
        "/static/%00", "/docs/%2e%2e/%2e%2e/%2e%2e/pyproject.toml", "/docs//etc/passwd", "/../etc/passwd", "/server.py",
    ],
)  # fmt: skip
def test_pages_of_the_program_are_those_meant_for_it(own, path):
    answer = own.ask(path)
    assert answer.status in (400, 404, 405) and answer.error is None, (answer.status, answer.error)
    assert "root:" not in answer.text and "import" not in answer.text and "[project]" not in answer.text


@pytest.mark.parametrize("up", UP[1::3])
def test_no_name_in_a_query_or_a_body_leads_out(own, up):
    up, before = up.replace("{outside}", str(own.outside)), tree(own.outside)
    for answer in (
        own.ask(f"/compare?design={up}&design=made"),
        own.ask(f"/api/design/made/run?kind={up}"),
        own.ask(f"/api/design/made/stop?kind={up}", method="POST"),
        own.ask(f"/api/design/made/go-on?kind={up}", method="POST"),
        own.ask("/api/scenes", {"light": "sun", "picture": up}),
        own.ask("/api/scenes", {"light": up}),
        own.ask("/api/scenes", {"template": up}),
        own.ask("/api/scenes", {"template": "thu", "picture": f"../{up}"}),
    ):
        assert answer.status in (200, 400) and answer.error is None, (answer.status, answer.error)
        assert SECRET not in answer.text and not tells(own, answer, up)
    assert tree(own.outside) == before


def test_a_scene_designs_into_the_folder_of_designs_whatever_its_name(own):
    for name in ("../../secret", str(own.outside / "evil"), "..", ".hidden", "a\\..\\b", "made\n"):
        own.workspace.change("small", scene_text.changed(SMALL, "name", name))
        answer = own.ask("/api/scene/small/make", {})
        assert answer.status in (200, 400), answer.error
        if answer.status == 200:
            assert re.fullmatch(r"[A-Za-z0-9_][\w.-]*", answer.json["design"])
    places = {path.parent for path in own.outside.rglob("job.json")}
    assert places and all(place.parent == own.folder for place in places)


def test_a_design_is_not_begun_over_files_of_another_kind(own):
    (own.folder / "small").mkdir()
    (own.folder / "small/thesis.txt").write_text("years of work")
    answer = own.ask("/api/scene/small/make", {})
    assert answer.status == 400 and "contains files that are not a design's" in answer.json["sentence"]
    assert str(own.outside) not in answer.text


# ---- where the folders are -------------------------------------------------------------------------------------------

FAULTS = {
    "unknown key": SMALL + "x = 1\n",
    "no picture": SMALL.replace("uniform = true", 'image = "pictures/none.png"'),
    "picture further up": SMALL.replace("uniform = true", 'image = "../none.png"'),
    "folder as a picture": SMALL.replace("uniform = true", 'image = "made"'),
    "no picture in the file": SMALL.replace("uniform = true", 'image = "small.toml"'),
    "no front": SMALL.replace('{ kind = "plane", z = 0.0 }', '{ kind = "bspline", z = 0.0, file = "none.npz" }'),
    "front that is none": SMALL.replace(
        '{ kind = "plane", z = 0.0 }', '{ kind = "bspline", z = 0.0, file = "small.toml" }'
    ),
    "material": SMALL.replace('"PMMA"', '"shelf/../../x.yml"'),
    "huge number": SMALL.replace("100.0", "1" + 400 * "0").replace("-8.0", "-1" + 400 * "0", 1),
    "no tables": 'name = "x"\nsource = 1\nlens = 2\ntarget = 3\n',
}


@pytest.mark.parametrize("what", suite.in_turns(FAULTS, 2))
def test_no_answer_about_a_faulty_scene_tells_where_the_folders_are(own, monkeypatch, what):
    monkeypatch.setattr(server, "ANSWER_TIMEOUT", 0.01)
    (own.folder / "faulty.toml").write_text(FAULTS[what])
    (own.folder / "pictures").mkdir()
    for path, method in (each for each in routes(own.workbench) if "/scene/" in each[0]):
        body = {"page": "p", "number": 1, "key": "target.z", "words": "120"} if method == "POST" else b""
        answer = own.ask(f"{filled(path, 'faulty')}?page=p&number=1&stage=0", body, method)
        assert answer.status < 500 and answer.error is None, (path, answer.status, answer.error)
        for place in (str(own.outside), str(Path.home()), str(Path.cwd())):
            assert place not in answer.text, (path, re.findall(f".{{0,80}}{place}.{{0,80}}", answer.text))


def test_what_a_run_says_is_told_without_folders(own):
    """The page of the design shows no folder either."""
    run = Run(own.folder / "made")
    run.folder.mkdir()
    sentence = f"{own.folder}/made: the finished design is kept in {own.folder}/made-unwritten"
    State("failed", folder="made", sentence=sentence).put(run.folder)
    design_process.ProgressFile(run.folder / design_process.PROGRESS)("reach", 0, 1, f"{own.folder}/x.png is dark")
    news = own.ask("/api/design/made/run")
    assert news.json["sentence"] == "made: the finished design is kept in made-unwritten"
    assert news.json["lines"][0][4] == "x.png is dark"
    for answer in (news, own.ask("/design/made"), own.ask("/")):
        assert answer.status == 200 and str(own.outside) not in answer.text


def test_each_section_leads_to_the_documentation_built_or_not(own):
    """Without built pages their Markdown stands there; no link leads nowhere."""
    links = set()
    for page in ("/", "/scene/small", "/design/made"):
        links |= {*re.findall(r'href=\\?"(/docs/[^"#\\]+)', own.ask(page).text)}
    assert len(links) >= 8 and {"/docs/reference/scene-keys.html", "/docs/how-to/tolerances.html"} <= links
    for link in sorted(links):
        answer = own.ask(link)
        assert answer.status == 200 and len(answer.text) > 1500, link
    assert "target.crop" in own.ask("/docs/reference/scene-keys.html").text
    assert own.ask("/docs/no/such.html").status == 404


def test_the_figure_of_a_design_follows_dark_mode(own, small_design):
    """Background and letters change; a design whose arrays are missing has the usual figure."""
    shutil.copytree(small_design.folder, own.folder / "real")
    usual, dark = (
        np.asarray(Image.open(io.BytesIO(own.ask(address).body)).convert("RGB")).astype(int)
        for address in ("/design/real/files/figures/irradiance.png", "/api/design/real/irradiance-dark.png")
    )
    assert np.abs(dark[0, 0] - [20, 24, 28]).max() <= 2 and (usual[0, 0] == 255).all()
    letters = [np.abs(image[-40:].mean(-1) - image[0, 0].mean()).max() for image in (usual, dark)]  # of the footnote
    assert min(letters) > 100
    assert own.ask("/api/design/made/irradiance-dark.png").body == own.files["figures/irradiance.png"]
    for page in ("/design/real", "/compare?design=real&design=made"):
        assert 'media="(prefers-color-scheme: dark)"' in own.ask(page).text


def test_the_page_of_a_design_says_down_to_which_cell_its_light_is_right(own, small_design):
    """A design whose light was measured on pixels alone has no such part."""
    shutil.copytree(small_design.folder, own.folder / "real")
    page, bare = own.ask("/design/real").text, own.ask("/design/made").text
    assert "The light on the target is right" in page and "on half pixels" in page
    assert own.ask("/design/real/files/figures/cell_error.png").body.startswith(b"\x89PNG")
    assert 'src="/design/real/files/figures/cell_error.png" alt="RRMSD against' in page
    assert "cell_error" not in bare and "half pixels" not in bare


@pytest.mark.parametrize("stage", ["preview", "effects"])
def test_a_preview_that_fails_is_told_without_folders(own, monkeypatch, stage):
    fault = FileNotFoundError(2, "No such file or directory", str(own.folder / "pictures/x.png"))
    monkeypatch.setattr(own.workbench.desk, "answer", lambda *_: (stage, fault))
    answer = own.ask("/api/scene/small/preview", {"page": "p", "number": 1})
    assert answer.status == 200 and "the computation failed" in answer.json["refused"]
    assert str(own.outside) not in answer.text


def test_the_page_is_told_up_to_which_throw_the_picture_is_sharp(own, monkeypatch):
    throw = {"throw": 42.3, "distance": 250.0, "cell": 0.39, "spot": 2.31, "spots": {"source": 2.3, "form": 0.2}}
    throw |= {"grade": "moulded", "words": "moulded plastic", "assumed": True, "unit": "mm"}
    goals = [{"key": "target", "left_out": [], "sharp_throw": throw}]
    plan = {"simulated": [], "goals": goals, "net": "129 control points"}
    monkeypatch.setattr(own.workbench.desk, "answer", lambda *_: ("effects", plan))
    told = own.ask("/api/scene/small/preview", {"page": "p", "number": 1}).json["sharp"]
    assert told == (
        "The picture is sharp up to a throw of 42 mm, where a point of it would be 0.39 mm wide, a pixel; on the "
        "target, 250 mm from the back, a point of the picture is 2.3 mm wide: 2.3 mm by the source, 0.2 mm by the form "
        "(part: moulded plastic; assumed, since the scene states no grade)."
    )
    goals[0]["sharp_throw"] = None
    assert own.ask("/api/scene/small/preview", {"page": "p", "number": 1}).json["sharp"] == ""


# ---- requests that are wrong -----------------------------------------------------------------------------------------

WRONG = [
    {}, {"key": "target.z"}, {"words": "1"}, {"key": "", "words": "1"}, {"key": "a..b", "value": 1},
    {"key": "target[99].z", "value": 1}, {"key": [], "value": 1}, {"key": "target.z", "value": float("nan")},
    {"key": "target.z", "value": 10**400}, {"text": {}}, {"key": "target.z", "words": "9" * 5000},
    {"key": "target", "value": [[[]]]}, {"key": "title", "value": "\ud800"}, {"key": "__class__.x", "value": 1},
    {"key": "source.kind", "value": {"a": 1}}, {"key": ".".join("a" * 400), "value": 1}, {"text": "\0\r\r\n"},
    {"text": "a = " + "[" * 300 + "]" * 300}, {"key": "lens", "value": None}, {"key": "target.x", "value": [{}, []]},
    {"key": "target.x", "value": json.loads("[" * 200 + "]" * 200)}, {"key": "title", "words": "\0\x1b[2J\u2028"},
    {"key": "target.image", "words": "../../secret.txt"}, {"key": "name", "words": ".."}, {"text": "\ud800"},
    {"budget": "soon"}, {"budget": []}, {"budget": "nan"}, {"budget": 1e400}, {"yield": {}}, {"yield": 1e9},
    {"grade": []}, {"grade": "../x"}, {"page": "p"}, {"page": "p", "number": "one"}, {"number": 1}, {"light": {}},
    {"light": "laser", "sample": []}, {"picture": {}}, {"page": "p", "number": 10**400},
]  # fmt: skip


@pytest.mark.parametrize("asked", suite.in_turns(WRONG, 4), ids=lambda asked: ascii(asked)[:40])
def test_no_table_of_json_breaks_the_server_or_the_scene(own, monkeypatch, asked):
    """Any table is refused in a sentence or accepted; then the page opens, and the change can be dropped."""
    monkeypatch.setattr(server, "ANSWER_TIMEOUT", 0.01)
    for path in READS_JSON:
        answer = own.ask(path, json.dumps(asked))
        assert answer.status in (200, 400) and answer.error is None, (path, answer.status, answer.error)
        assert (answer.status == 200 or answer.json["sentence"]) and SECRET not in answer.text
    assert own.ask("/scene/small").status == 200
    own.ask("/api/scene/small/drop", {})
    assert own.workspace.opened("small").saved


@pytest.mark.parametrize(
    "query",
    ["?", "?page=p", "?page=p&number=x&stage=0", "?page=p&number=1&stage=x", "?page=p&number=1&stage=9",
     "?page=p&number=1&stage=-1", "?since=x", "?since=-5", "?since=1e9", "?kind=", "?since=99999999999999999999"],
)  # fmt: skip
def test_no_query_breaks_the_server(own, monkeypatch, query):
    monkeypatch.setattr(server, "ANSWER_TIMEOUT", 0.01)
    own.ask("/api/scene/small/preview", {"page": "p", "number": 1})
    for path in ("/api/scene/small/answer", "/api/design/made/run"):
        answer = own.ask(f"{path}{query}")
        assert answer.status in (200, 400) and answer.error is None, (answer.status, answer.error)


def test_a_line_of_a_thousand_dots_takes_no_time(own):
    """tomllib needs the square of their number."""
    text, began = "a." * 20_000 + "a = 1\n", time.perf_counter()
    assert own.ask("/api/scene/small/change", {"text": text}).json["error"]
    (own.folder / "dots.toml").write_text(text)
    assert own.ask("/scene/dots").status == 200
    assert time.perf_counter() - began < 2.0


def test_a_fault_of_the_program_is_a_sentence_and_the_terminal_has_the_rest(own, monkeypatch, capfd):
    def broken(self, name):
        raise RuntimeError(f"no such thing as {self.designs}")

    monkeypatch.setattr(Workspace, "opened", broken)
    answer = own.ask("/api/scene/small")
    assert answer.status == 500 and "RuntimeError: no such thing" in answer.json["sentence"]
    assert str(own.outside) not in answer.text and "broken" in capfd.readouterr().err
    page = own.ask("/scene/small")
    assert page.status == 500 and "RuntimeError: no such thing" in page.text and str(own.outside) not in page.text


# ---- changes ---------------------------------------------------------------------------------------------------------


def test_a_change_is_told_and_saved_as_the_workspace_has_it(own):
    told = own.ask("/api/scene/small/change", {"key": "target.z", "words": "120"}).json
    assert (told["saved"], told["error"]) == (False, None)
    assert told["text"] == SMALL.replace("100.0", "120.0") == own.workspace.opened("small").text
    assert own.ask(f"/api/scene/small?revision={told['revision']}").json == {"revision": told["revision"]}
    own.workspace.path("small").write_text(SMALL + "# theirs\n")
    answer = own.ask("/api/scene/small/save", {})
    assert answer.status == 400 and "was changed by another program" in answer.json["sentence"]
    assert own.ask("/api/scene/small/save", {"anyway": True}).json["saved"]
    assert own.workspace.path("small").read_text() == told["text"]
    assert own.ask("/api/scene/small/drop", {}).json["text"] == told["text"]


def test_a_new_scene_of_an_uploaded_picture(own):
    sent = own.ask("/api/picture", png(30, 20)).json["picture"]
    for asked in ({"light": "sun"}, {"template": "thu"}, {"template": "two_pictures"}):
        name = own.ask("/api/scenes", {**asked, "picture": sent}).json["name"]
        told = own.ask(f"/api/scene/{name}").json
        assert told["error"] is None and f'image = "pictures/{sent}"' in told["text"]


# ---- what comes from elsewhere is no script --------------------------------------------------------------------------


def test_what_a_folder_from_elsewhere_says_is_no_script(own):
    evil = "</script><script>alert(1)</script><img src=x onerror=alert(1)>"
    (own.folder / "evil.toml").write_text(SMALL.replace("An evenly", evil) + f"title = '''{evil}'''\n")
    (own.folder / "odd.toml").write_text(SMALL.replace('"small"', f"'{evil}'"))
    files = made(own.folder / "evil", title=evil, given_up=(evil,))
    (own.folder / "evil" / evil.replace("/", "")).write_text("x")
    run = Run(own.folder / "evil")
    run.folder.mkdir()
    State("failed", sentence=evil).put(run.folder)
    scene = scene_text.changed(files["scene.toml"].decode(), "title", evil)
    (own.folder / "evil/scene.toml").write_text(scene)
    pages = [
        own.ask(path) for path in ("/", "/scene/evil", "/scene/odd", "/design/evil", "/compare?design=made&design=evil")
    ]
    forms = [own.ask(f"/api/scene/{name}").json.get("form") or "" for name in ("evil", "odd")]
    for page in (*(each.text for each in pages), *forms):
        assert "<script>alert" not in page and "<img src=x" not in page
    assert [page.status for page in pages] == [200] * 5


@pytest.mark.parametrize("name", ["report.html", "figures/deep/page.html"])
def test_a_page_of_a_design_has_no_origin(own, name):
    (own.folder / "made" / name).write_text("<script>fetch('/api/scenes')</script>")
    answer = own.ask(f"/design/made/files/{name}")
    policy = answer["content-security-policy"]
    assert answer.status == 200 and answer["content-type"].startswith("text/html")
    assert "sandbox" in policy.split("; ")[0].split() and "allow-same-origin" not in policy
    assert "default-src 'none'" in policy and "connect-src" not in policy and "'self'" not in policy
    assert answer["x-content-type-options"] == "nosniff"
    assert own.ask(f"/design/made/files/{name}?download")["content-disposition"].startswith("attachment")


@pytest.mark.parametrize("name", ["a.svg", "a.htm", "a.xhtml", "a.mjs", "a.HTML", "a", "a.html.gz"])
def test_other_files_of_a_design_are_kept_not_shown(own, name):
    (own.folder / "made" / name).write_text("<script>alert(1)</script>")
    answer = own.ask(f"/design/made/files/{name}")
    assert answer["content-type"].startswith("application/octet-stream")
    assert answer["content-disposition"].startswith("attachment")


# ---- files -----------------------------------------------------------------------------------------------------------


def test_a_designs_archive_holds_every_file_with_its_bytes(own):
    files = own.files | {"big.bin": os.urandom(3 * MB), "Größe µ.txt": b"x"}
    for name in ("big.bin", "Größe µ.txt"):
        (own.folder / "made" / name).write_bytes(files[name])
    (own.folder / "made/.hidden").write_text(SECRET)
    os.symlink(own.outside / "secret.txt", own.folder / "made/out.txt")
    os.symlink(own.outside, own.folder / "made/outside")
    (own.folder / ".made.checkpoint").write_text(SECRET)
    answer = own.ask("/design/made/all.zip")
    assert answer.status == 200 and answer.error is None, answer.error
    assert answer["content-disposition"] == 'attachment; filename="made.zip"'
    with zipfile.ZipFile(io.BytesIO(answer.body)) as archive:
        assert archive.testzip() is None
        held = {name: archive.read(name) for name in archive.namelist()}
    assert held == {f"made/{name}": data for name, data in files.items()}
    assert len(answer.body) < sum(map(len, files.values())) + 10_000  # nothing is sent twice
    listed = re.findall(r'<a href="/design/made/files/([^"]*)\?download"', own.ask("/design/made").text)
    assert len(listed) >= len(files)


def test_every_file_of_the_list_is_sent_with_its_bytes(own):
    for name, data in own.files.items():
        assert own.ask(f"/design/made/files/{name}?download").body == data
    assert own.ask("/design/made/files/lens.step?download", range="bytes=10-19").body == own.files["lens.step"][10:20]


def test_a_blank_as_built_is_a_run_with_what_was_measured(own):
    body = json.dumps({"thickness": "10,5".replace(",", "."), "index": ""}).encode()
    assert own.ask("/api/design/made/retailor", body).status == 200
    job = json.loads((Run(own.folder / "made", "retailor").folder / "job.json").read_bytes())
    assert (job["kind"], job["thickness"], job["index"]) == ("retailor", 10.5, None)
    for nothing in ({}, {"thickness": "", "index": None}):
        refused = own.ask("/api/design/made/retailor", json.dumps(nothing).encode())
        assert refused.status == 400 and b"give what was measured of the blank" in refused.body
    assert own.ask("/api/design/made/compensate", b"x,y,z\n1,2,3\n").status == 200
    assert [path.name for path in Run(own.folder / "made", "compensate").folder.glob("cloud*")] == ["cloud.csv"]


def test_files_for_the_shop_are_a_run_with_their_kind(own):
    body = {"kind": "raster", "tool_radius": "1.5", "tiles": ""}
    assert own.ask("/api/design/made/export", json.dumps(body).encode()).status == 200
    job = json.loads((Run(own.folder / "made", "export").folder / "job.json").read_bytes())
    assert (job["kind"], job["tool_radius"], job["tiles"]) == ("raster", 1.5, "")
    refused = own.ask("/api/design/made/export", b'{"kind": "zemax"}')
    assert refused.status == 400 and b"no file for a shop" in refused.body


def test_a_copy_has_the_title_that_it_is_given(own):
    for title in ("Another lamp", None):
        answer = own.ask("/api/design/made/edit", json.dumps({"title": title}).encode())
        text = (own.folder / f"{answer.json['name']}.toml").read_text(encoding="utf-8")
        assert answer.status == 200 and ('title = "Another lamp"' in text) == (title is not None)


def test_a_part_is_judged_by_points_kept_by_no_senders_name(own):
    kinds = {b"x,y,z\n1,2,3\n": ".csv", b"ply\nformat": ".ply", b"solid x": ".stl", bytes(90): ".stl"}
    kinds |= {
        b"PK\x03\x04": ".x3p",
        b"bISO-2.0": ".sdf",
        b"\x01\x00Directory\x00": ".opd",
        b"\x89HDF\r\n\x1a\n": ".datx",
    }
    kinds |= {b"VCA DATA\x01\x00": ".opdx", b"DIGITAL SURF\x00": ".sur"}
    for data, ending in kinds.items():
        words = {"content_disposition": 'attachment; filename="../../evil.sh"', "content_type": "text/x-sh"}
        assert own.ask("/api/design/made/measured?name=../evil", data, **words).status == 200
        [cloud] = Run(own.folder / "made", "measured").folder.glob("cloud*")
        assert (cloud.name, cloud.read_bytes()) == (f"cloud{ending}", data)
    assert "evil" not in " ".join(tree(own.outside))
