"""The house rules: who may import whom, and what `import bstcad` may load."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "bstcad"

# A part of the package, and the parts it may import besides itself.
READING = {  # the scene and its reading
    "scene", "target", "limits", "picture", "tones", "framing", "lettering", "quality", "sentences", "files", "values",
}  # fmt: skip
ENGINE = {*READING, "optics", "transport", "tailoring", "cad", "verify"}
MAY_IMPORT = {
    "optics": set(),
    "transport": set(),
    **dict.fromkeys(READING, {*READING, "optics"}),
    "tailoring": {*READING, "optics", "transport", "checkpoint"},
    "cad": {*READING, "optics"},
    "beside": set(),
    "checkpoint": {"files"},
    "lock": {"sentences"},
    "signals": set(),
    "machine": {"beside", "bstcad"},
    "verify": {*READING, "optics", "cad", "beside"},
    "pipeline": {*ENGINE, "checkpoint", "bstcad"},
    "folder": {*ENGINE, "pipeline", "beside"},
    "commands": {*ENGINE, "pipeline", "folder", "beside", "checkpoint", "lock", "machine", "signals", "bstcad"},
    "start": READING,
    "designs": {*ENGINE, "pipeline", "folder", "commands", "lock", "progress"},
    "tradeoff": {*ENGINE, "pipeline", "bstcad"},
    "progress": set(),
    "cli": {
        *(*ENGINE, "pipeline", "commands", "start", "tradeoff", "progress", "beside", "checkpoint", "lock", "signals"),
        "bstcad",
    },
    "bstcad": {*ENGINE, "designs", "tradeoff", "progress", "cli"},  # __init__
}
# A library, and the only parts that may import it.
ONLY = {
    "OCP": {"cad"},
    "cadquery": {"cad"},
    "matplotlib": {"verify"},
    "pyvista": {"verify"},
    "vtk": {"verify"},
    "vtkmodules": {"verify"},
    "pydantic": READING,
    "typer": {"cli"},
    "loky": {"beside"},
    "pillow_heif": {"picture"},
}
HEAVY = ("torch", "numpy", "scipy", "numba", "OCP", "cadquery", "matplotlib", "pyvista", "vtkmodules", "PIL")
SOURCES = sorted(PACKAGE.rglob("*.py"))


def part(path):
    """The part of the package a file belongs to."""
    first = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    return "bstcad" if first == "__init__" else first


def imported(path):
    """Every module a file imports, at its top or inside a function, as absolute dotted names."""
    here = ("bstcad", *path.relative_to(PACKAGE).with_suffix("").parts)
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join((*here[: -node.level], node.module or "")).rstrip(".") if node.level else node.module
            yield from (f"{base}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("import_module", "submit")):
            yield from (argument.value for argument in node.args if dotted(argument))


def dotted(argument):
    """Is it the name of a module or of something in one, to be loaded here or in the second process?"""
    return isinstance(argument, ast.Constant) and re.fullmatch(r"\w+(\.\w+)+", str(argument.value))


def wrong_imports(path, owner):
    """The imports of a file of part `owner` that the rules forbid."""
    for module in imported(path):
        library, *inner = module.split(".")
        if library == "bstcad":
            public = path.parent / f"{inner[0]}" if inner else path
            name = inner[0] if inner and (public.exists() or inner[0] in MAY_IMPORT) else "bstcad"
            if name not in MAY_IMPORT[owner] | {owner}:
                yield module
        elif owner not in ONLY.get(library, {owner}):
            yield module


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_keep_to_the_house(path):
    assert part(path) in MAY_IMPORT, "a new part of the house: say here what it may import"
    assert list(wrong_imports(path, part(path))) == []


@pytest.mark.parametrize(
    ("owner", "line"),
    [
        ("optics", "from bstcad.scene import Scene"),
        ("optics", "def f():\n    import bstcad.cad.step"),
        ("optics", "def f():\n    submit('bstcad.cad.step.write', 1)"),
        ("transport", "from bstcad.optics import trace"),
        ("verify", "from bstcad.tailoring import merit"),
        ("verify", "from bstcad import transport"),
        ("tailoring", "import OCP.gp"),
        ("scene", "def f():\n    from matplotlib import pyplot"),
        ("tailoring", "from bstcad import load"),
        ("tailoring", "from ..verify import report"),
    ],
)
def test_a_broken_rule_is_found(tmp_path, monkeypatch, owner, line):
    monkeypatch.setattr(sys.modules[__name__], "PACKAGE", tmp_path)
    path = tmp_path / owner / "file.py"
    path.parent.mkdir()
    path.write_text(line)
    assert len(list(wrong_imports(path, owner))) == 1


UNSAFE = {
    "pickle",
    "cPickle",
    "cloudpickle",
    "dill",
    "joblib",
    "marshal",
    "shelve",
    "yaml",
    "ruamel",
}  # run what they read
CALLS = {"eval", "exec", "__import__", "os.system", "os.popen", "torch.load", "input"}
FLAGS = {("shell", True), ("allow_pickle", True), ("weights_only", False)}


def what_runs_strangers_code(tree):
    """The names in a syntax tree by which a file from elsewhere could have its own code run."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else [node.module or ""]
            yield from (module for module in modules if module.split(".")[0] in UNSAFE)
        elif isinstance(node, ast.Name | ast.Attribute) and ast.unparse(node) in CALLS:
            yield ast.unparse(node)
        elif isinstance(node, ast.Call):
            flags = [(word.arg, getattr(word.value, "value", None)) for word in node.keywords]
            yield from (word for word, value in flags if (word, value) in FLAGS)


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_nothing_that_is_read_is_run(path):
    assert list(what_runs_strangers_code(ast.parse(path.read_text()))) == []


@pytest.mark.parametrize(
    "line",
    [
        "import pickle", "from pickle import loads", "import yaml.nodes", "eval('1')", "x = list(map(exec, y))",
        "__import__('os')", "import os\nos.system('ls')", "subprocess.run('ls', shell=True)",
        "np.load(f, allow_pickle=True)", "torch.load(f)", "def f():\n    from marshal import load",
    ],
)  # fmt: skip
def test_what_would_run_it_is_found(line):
    assert len(list(what_runs_strangers_code(ast.parse(line)))) == 1


# Where a product is no dense one that BLAS divides among threads as it likes, and why.
PRODUCTS = {
    "optics/bspline.py": "of sparse matrices",
    "tailoring/slope_fit.py": "by a sparse matrix",
    "tailoring/spectrum.py": "on a GPU",
    "transport/density.py": "by a sparse matrix",
}
DIVIDED = re.compile(
    r"(torch|np)\.(matmul|mm|bmm|mv|einsum|tensordot|dot|inner|vdot|linalg\b.*)|torch\.nn\.functional\.(conv|normalize|linear).*"
    r"|torch\.(exp|expm1|sin|cos|tan|pow|log|arccos|atan2)"  # which round otherwise where a thread's share ends
)


def what_depends_on_threads(tree):
    """Calls and operators of a syntax tree whose last bits may depend on the number of threads."""
    for node in ast.walk(tree):
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult):
            yield "@"
        elif isinstance(node, ast.Call) and DIVIDED.fullmatch(name := ast.unparse(node.func)):
            yield name


@pytest.mark.parametrize(
    "path", [p for p in SOURCES if part(p) in ("optics", "transport", "tailoring")], ids=lambda p: p.name
)
def test_no_bit_of_a_design_depends_on_threads(path):
    found = set(what_depends_on_threads(ast.parse(path.read_text())))
    assert found <= ({"@"} if str(path.relative_to(PACKAGE)) in PRODUCTS else set())


@pytest.mark.parametrize("line", ["a @ b", "x = torch.linalg.solve(a, b)", "np.linalg.lstsq(a, b)", "torch.exp(x)"])
def test_what_would_depend_on_them_is_found(line):
    assert len(set(what_depends_on_threads(ast.parse(line)))) == 1


@pytest.mark.parametrize("module", ["bstcad", "bstcad.cli"])
def test_import_is_light(module):
    heavy = (*HEAVY, "pydantic")  # not at --help: some versions of typer read their options with it
    code = f"import sys, {module}; print([m for m in {heavy!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=PACKAGE.parent)
    assert done.stdout.strip() == "[]", done.stderr


def test_help_is_light():
    code = (
        "import sys\nfrom bstcad import cli\n"
        f"assert cli.run(['generate', '--help']) == 0\nprint([m for m in {HEAVY!r} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=PACKAGE.parent)
    assert done.stdout.splitlines()[-1] == "[]", done.stderr


def test_a_list_of_templates_is_light():
    code = (
        "import sys\nfrom bstcad import cli\n"
        f"assert cli.run(['new', '--list']) == 0\nprint([m for m in {HEAVY!r} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=PACKAGE.parent)
    assert done.stdout.splitlines()[-1] == "[]", done.stderr


def test_the_public_api_is_what_it_says():
    import bstcad
    from bstcad.scene import Scene, load

    assert bstcad.load is load and bstcad.Scene is Scene
    assert set(bstcad.__all__) <= set(dir(bstcad))
    with pytest.raises(AttributeError, match="no attribute 'lens'"):
        _ = bstcad.lens
