"""Generated pages of docs/reference (keys of a scene, commands, JSON files), and tables that other pages include."""

from __future__ import annotations

import ast
import inspect
import io
import re
import tokenize
import tomllib
import typing
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
PAGES = ROOT / "docs" / "reference"
TABLES = ROOT / "docs" / "_made"  # folder of the tables that pages include
NOUNS = ("Surface", "Chart", "Emitter", "Receiver", "FittedFront", "FileContent")  # classes whose kinds house.md lists
RECORDS = {  # JSON file: (module, names of its records), with the record of the file first
    "report.json": [
        ("report/record.py", ["Contents", "LineFigures", "LeftOut"]),
        ("designs/course.py", ["StageRecord", "CurvePoint", "PrecisionTest"]),
        ("report/goal_figures.py", ["GoalFigures", "CellFigures", "WavefrontFigures", "Photometry"]),
        ("analysis/top_hat.py", ["FlatTop"]),
        ("analysis/cost.py", ["ConvergenceEnd"]),
        ("verify/verdict.py", ["Check"]),
        ("verify/light_limits.py", ["LightValue"]),
        ("analysis/light.py", ["Blur", "FinestDetail"]),
        ("analysis/sharp_throw.py", ["SharpThrow"]),
        ("verify/judges/comparison.py", ["Judge"]),
        ("report/prescription.py", ["Order"]),
    ],
    "tolerance.json": [
        (
            "manufacture/tolerance/tolerances.py",
            ["Tolerances", "Grade", "Sensitivity", "Trial", "Inverse", "TargetStudy", "WavefrontStudy"],
        )
    ],
    "batch.json": [("planning/batch.py", ["Batch", "BatchEntry"])],
    "tradeoff.json": [
        ("planning/results.py", ["TradeoffTable", "TableKnob", "Calibration", "Preset", "KnobPoint"]),
        ("planning/cold_run.py", ["ColdRun", "HistoryPoint"]),
    ],
    "compensation.json": [
        ("manufacture/shop/production.py", ["RoundFigures", "CloudFigures", "DeviationFigures", "RoundLight"])
    ],
    "state.json": [("app/design_process.py", ["State"])],
}


# ---- keys of a scene -------------------------------------------------------------------------------------------------


def scene_keys() -> str:
    """The page of all keys: a section a table, a row a key."""
    from bstcad.scene.schema import rows, toml

    examples, tables = examples_of_keys(), {}
    for row in rows():
        table = row.key.partition(".")[0] if row.range in ("table", "tables") or "." in row.key else "name and title"
        tables.setdefault(table, []).append(row)
    page = [
        "# Keys of a scene",
        "",
        "A scene is a TOML file that describes a lens, its light and its picture. Lengths are in mm, angles in",
        "degrees, wavelengths in nm. The rows are those of `bstcad keys` and come from the schema that checks a scene.",
        "",
        "Where the default is empty, the key may be absent; for most keys of `[tailoring]` its value then depends on",
        "`tailoring.quality`. The range applies to each number of a list. `[]` marks a list of tables, such as",
        "`[[effects]]` for `effects[]`.",
        "A meaning that begins with words such as `point:` holds for tables of that `kind` or `shape` only; if a key",
        "has several rows, each kind has its own. A key that is `required` is required only if its table is stated.",
        "",
    ]
    for table, keys in tables.items():
        page += [
            f"(keys-{table.rstrip('[]').partition(' ')[0]})=",
            f"## `{table}`" if " " not in table else "## Name and title",
            "",
        ]
        page += ["| key | unit | range | default | example | meaning |", "|---|---|---|---|---|---|"]
        for row in keys:
            meaning = f"{', '.join(row.kinds)}: {row.meaning}".removeprefix(": ")
            name = row.key.replace("[]", "")
            example = examples.get((name, row.kinds), examples.get((name, ())))
            shown = "" if row.range in ("table", "tables") or example is None else code(toml(example))
            cells = f"`{row.key}`", row.unit, row.range, code(row.default), shown, meaning
            page.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
        page.append("")
    return "\n".join(page)


def code(text: str) -> str:
    """Text as code; nothing stays nothing."""
    return f"`{text}`" if text else ""


def examples_of_keys() -> dict[tuple[str, tuple[str, ...]], Any]:
    """A value of each key that scenes of the templates and of the pages give, else the schema's example."""
    from bstcad.scene.schema import rows

    scenes = [tomllib.loads(path.read_text(encoding="utf-8")) for path in sorted((ROOT / "templates").glob("*.toml"))]
    for page in sorted((ROOT / "docs").glob("*/*.md")):
        for text in re.findall(r"^```toml\n(.*?)^```", page.read_text(encoding="utf-8"), re.S | re.M):
            scenes.append(tomllib.loads(text))
    examples = {}
    for scene in scenes:
        for key, value, kind in given(scene):
            examples.setdefault((key, ()), value)
            examples.setdefault((key, (kind,)), value)
    for row in rows():
        if row.example is not None:
            for kinds in {(), row.kinds}:
                examples.setdefault((row.key.replace("[]", ""), kinds), row.example)
    return examples


def given(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any, str]]:
    """(dotted key, value, kind of its table) of all values of a TOML table."""
    kind = str(table.get("kind", table.get("shape", "")))
    for name, value in table.items():
        key = f"{prefix}.{name}".lstrip(".")
        inner = [value] if isinstance(value, dict) else value if isinstance(value, list) else []
        tables = [part for part in inner if isinstance(part, dict)]
        for part in tables:
            yield from given(part, key)
        if not tables:
            yield key, value, kind


# ---- command line ----------------------------------------------------------------------------------------------------


def command_line() -> str:
    """The page of the commands, by typer from the program itself."""
    import click
    import typer
    from typer.cli import get_docs_for_click

    from bstcad.cli import app

    group = typer.main.get_command(app)
    page = get_docs_for_click(obj=group, ctx=click.Context(group, info_name="bstcad"), name="bstcad")
    page = page.replace("# `bstcad`", "# Command line", 1).replace("```console", "```text")
    exits = (
        "Exit codes:\n\n"
        "- 0: no check failed. `bstcad tolerance` exits with 0 at any yield, also below that of `--yield`.\n"
        "- 1: a check failed, an error ended a design of `batch`, or no run of `tradeoff` has a lens.\n"
        "- 2: the input is wrong, or the machine cannot do the work (for example, its disk is full).\n"
        "- 70: a fault of bstcad.\n"
        "- 129, 130, 143: the command was ended by SIGHUP, Ctrl-C or SIGTERM.\n\n"
    )
    return page.replace("## `bstcad generate`", exits + "## `bstcad generate`", 1)


# ---- JSON files ------------------------------------------------------------------------------------------------------


def json_files() -> str:
    """Return the page of report.json and the other JSON files: one table per record, from its fields and comments."""
    page = [
        "# JSON files",
        "",
        "Programs read these files. Each file is written from, and read back into, the records below. The first record",
        "of a section is the whole file; the others are the types of its entries. Where a table says `None`, a file",
        "has `null`, or does not have the key; an empty list may be absent, too.",
        "Lengths are in mm, angles in degrees and times in s, unless the meaning names another unit. `Count`, `Rrmsd`,",
        "`Seconds`, `Size` and `Width` are numbers, a `Fraction` is a number from 0 to 1, and a `Point` is [x, y, z].",
        "RRMSD is the RMS difference between light and target, divided by the RMS of the target.",
        "",
        "- `Yield`: list of lower bound, estimate and upper bound of a yield (95 % interval).",
        "- `Spread`: values by the percentiles 5 %, 50 % and 95 %.",
        "- `Disagreement`: median and 95th percentile of the relative error.",
        "- `StoredSettings`: values by key of the scene.",
    ]
    for name, files in RECORDS.items():
        page += ["", f"## {name}", ""]
        for file, records in files:
            source = (ROOT / "bstcad" / file).read_text(encoding="utf-8")
            for record in records:
                page += record_table(source, record)
    return "\n".join(page) + "\n"


def record_table(source: str, name: str) -> list[str]:
    """Return a record as a section of the page: its docstring, and type and comment of each field."""
    [record] = [node for node in ast.parse(source).body if isinstance(node, ast.ClassDef) and node.name == name]
    comments = {
        token.start[0]: token.string.lstrip("# ")
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    }
    lines = source.splitlines()
    rows = []
    for field in record.body:
        if not isinstance(field, ast.AnnAssign) or ast.unparse(field.target).startswith("_"):
            continue
        above, first = [], field.lineno - 1
        while lines[first - 1].strip().startswith("#"):
            above.insert(0, comments[first])
            first -= 1
        meaning = " ".join([*above, comments.get(field.end_lineno, "")]).strip()
        annotation = ast.unparse(field.annotation)
        alias, kind = re.search(r"alias='(\w+)'", annotation), readable(annotation)
        rows.append(f"| `{alias[1] if alias else field.target.id}` | {cell(kind)} | {cell(meaning)} |")
    said = " ".join((ast.get_docstring(record) or "").partition("\n\n")[0].split())
    return [f"### {name}", "", said, "", "| key | type | meaning |", "|---|---|---|", *rows, ""]


def readable(kind: str) -> str:
    """An annotation without its validators."""
    kind = re.sub(r"Annotated\[(.*?), (?:Field|FailFast|Len|BeforeValidator|PlainSerializer)\(.*\)\]", r"\1", kind)
    return kind.replace("tuple[", "list[").replace(", ...]", "]").replace("Mapping[", "table[")


def cell(text: str) -> str:
    """Text of a table's cell, in which markdown marks nothing except code."""
    parts = re.split(r"(`[^`|]+`)", text)
    parts[::2] = [re.sub(r"([|\\*_<>\[\]`])", r"\\\1", part) for part in parts[::2]]
    return "".join(parts)


# ---- arrays of a design ----------------------------------------------------------------------------------------------


def arrays() -> str:
    """Return the table of the arrays of design.npz: name, shape, meaning."""
    from bstcad.designs.folder import ARRAYS

    rows = [f"| `{name}` | {shape} | {cell(meaning)} |" for name, (shape, meaning) in ARRAYS.items()]
    return "\n".join(["| array | shape | meaning |", "|---|---|---|", *rows]) + "\n"


# ---- tables of the house ---------------------------------------------------------------------------------------------


def rooms() -> str:
    """Return a table of the parts of the package, by AT_TOP and MAY_IMPORT of tests/test_architecture.py, from below.

    The contents of a part are the first lines of the docstrings of its __init__.py, or of its files.
    """
    from tests.test_architecture import AT_TOP, MAY_IMPORT

    page = ["| part | contents | may import, besides itself |", "|---|---|---|"]
    for part, others in MAY_IMPORT.items():
        if part == "bstcad":
            continue
        files = {name: f"{name}.py" for name in sorted(AT_TOP.get(part, ()))}
        said = [f"`{file}`: {first_line(file)}" for file in files.values()]
        said = said or [first_line(f"{part.replace('.', '/')}/__init__.py")]
        page.append(f"| `{part}` | {' '.join(said)} | {listed(others)} |")
    return "\n".join(page) + "\n"


def libraries() -> str:
    """Return the table ONLY of tests/test_architecture.py: the parts that may import a library."""
    from tests.test_architecture import ONLY

    rows = [f"| {name} | {listed(parts)} |" for name, parts in ONLY.items()]
    return "\n".join(["| library | may be imported by |", "|---|---|", *rows]) + "\n"


def listed(parts: set[str]) -> str:
    """Return the names of parts as code, without that of bstcad/__init__.py."""
    return ", ".join(f"`{part}`" for part in sorted(parts - {"bstcad"})) or "nothing"


def first_line(file: str) -> str:
    """Return the first line of the docstring of a file of the package."""
    docstring = ast.get_docstring(ast.parse((ROOT / "bstcad" / file).read_text(encoding="utf-8"))) or ""
    return cell(docstring.partition("\n")[0])


def kinds() -> str:
    """Return a table of the classes of the package that derive from each of NOUNS: noun, class, file, docstring."""
    classes = [
        (node, file.relative_to(ROOT / "bstcad").as_posix())
        for file in _files_of_kinds()
        for node in ast.parse(file.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ClassDef)
    ]
    page = ["| noun | kind | file | what it is |", "|---|---|---|---|"]
    for noun in NOUNS:
        known = {noun}
        while derived := [
            (node, file)
            for node, file in classes
            if node.name not in known and known & {ast.unparse(base).rpartition(".")[2] for base in node.bases}
        ]:
            known |= {node.name for node, _ in derived}
            for node, file in derived:
                if not node.name.startswith("_"):
                    said = (ast.get_docstring(node) or "").partition("\n\n")[0]
                    page.append(f"| `{noun}` | `{node.name}` | `{file}` | {cell(' '.join(said.split()))} |")
    return "\n".join(page) + "\n"


def _files_of_kinds() -> list[Path]:
    """Return the files with classes that derive from one of NOUNS, by their text: syntax trees of all take seconds."""
    classes = [
        (file, name, set(re.findall(r"\w+", bases)))
        for file in sorted((ROOT / "bstcad").rglob("*.py"))
        for name, bases in re.findall(r"^class (\w+)(?:\((.*?)\))?:", file.read_text(encoding="utf-8"), re.M | re.S)
    ]
    known = set(NOUNS)
    while derived := {name for _, name, bases in classes if bases & known} - known:
        known |= derived
    return list(dict.fromkeys(file for file, name, _ in classes if name in known))


# ---- grades of manufacture -------------------------------------------------------------------------------------------


def grades() -> str:
    """Return the limits of all grades, a row per limit with the errors that it bounds, and their finish."""
    from dataclasses import fields

    from bstcad.manufacture.tolerance.grades import GRADES, ToleranceGrade, limit_of
    from bstcad.optics.trace.finish import Finish
    from bstcad.scene.quality import FINISH_KEYS, Name

    names: dict[str, list[str]] = {}
    for name in typing.get_args(Name):
        if not name.endswith(("_x", "_y")):
            names.setdefault(limit_of(name), []).append(f"`{name}`")
    page = [f"| limit | errors | {' | '.join(f'`{name}`' for name in GRADES)} |", "|---|---|" + "--:|" * len(GRADES)]
    for field, said in field_comments(ToleranceGrade, [f.name for f in fields(ToleranceGrade)]).items():
        values = [getattr(grade, field) for grade in GRADES.values()]
        if field not in ("words", "finish"):
            page.append(f"| {cell(said)} | {', '.join(names.get(field, []))} | {numbers(values)} |")
    for key, said in field_comments(Finish, FINISH_KEYS).items():
        page.append(f"| {cell(said)} | `{key}` | {numbers(getattr(grade.finish, key) for grade in GRADES.values())} |")
    return "\n".join(page) + "\n"


def field_comments(record: type, names: Iterable[str]) -> dict[str, str]:
    """Return the comments of fields of a record by their names."""
    found = dict(re.findall(r"^    (\w+): [^#\n]+#[: ]*(.+)$", inspect.getsource(record), re.M))
    return {name: found[name] for name in names if name in found}


def numbers(values: Iterable[float]) -> str:
    """Return numbers as cells of a table; an infinite or absent one is empty."""
    return " | ".join(f"{value:g}" if value and value < float("inf") else "" for value in values)


def write(path: Path, text: str) -> None:
    """Write a page or a table, if it changes."""
    path.parent.mkdir(exist_ok=True)
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def make(app: Any = None) -> None:
    """Write the generated pages and tables."""
    for page, text in (
        ("scene-keys.md", scene_keys()), ("command-line.md", command_line()), ("json-files.md", json_files())
    ):  # fmt: skip
        write(PAGES / page, text)
    for table in (arrays, rooms, libraries, kinds, grades):
        write(TABLES / f"{table.__name__}.md", table())


def plain_text(app: Any, what: str, name: str, of: Any, options: Any, lines: list[str]) -> None:
    """Docstrings are plain text: in reStructuredText, *, | and a _ behind a word would be marks, `names` no code."""
    text = re.sub(r"(?<!`)`([^`\n]+)`(?!`)", r"``\1``", "\n".join(lines))
    parts = re.split(r"(``[^`]+``)", text)
    parts[::2] = [re.sub(r"([*|]|_\b)", r"\\\1", part) for part in parts[::2]]
    lines[:] = "".join(parts).split("\n")


def short_signature(app: Any, what: str, name: str, item: Any, options: Any, signature: str, returns: str) -> Any:
    """The signature of a class without the unit, range and meaning of each parameter (autodoc-process-signature)."""
    if what != "class" or not signature:
        return None
    from sphinx.util.inspect import stringify_signature

    types, own = typing.get_type_hints(item), inspect.signature(item)
    plain = [p.replace(annotation=types.get(p.name, p.annotation)) for p in own.parameters.values()]
    plain = own.replace(parameters=plain, return_annotation=own.empty)
    return stringify_signature(plain, unqualified_typehints=True), returns


def setup(app: Any) -> dict[str, bool]:
    """Sphinx calls it."""
    app.connect("builder-inited", make)
    app.connect("autodoc-process-docstring", plain_text, priority=100)
    app.connect("autodoc-process-signature", short_signature)
    return {"parallel_read_safe": True}
