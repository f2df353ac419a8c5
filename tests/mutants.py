"""Mutants: change one operator, constant or condition of the package, and run the tests that import its module.

    python -m tests.mutants --count 150 --seed 1 --only 3 17    # by the daily tests; --all: by the thorough ones, too

A mutant is killed if a test fails, or if the tests take longer than TIMEOUT.  A mutant that survives is equivalent, or
asks for a test.  `<` becomes `>=`, not `<=`, which differs only for equal numbers.
"""

import argparse
import ast
import copy
import os
import random
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
ROOMS = "optics", "transport", "tailoring", "cad", "verify", "step_text"
TIMEOUT = 900  # seconds for the tests of one mutant; a kernel is compiled again
COPIED = "bstcad", "tests", "templates", "docs", "generate_lens.py", "pyproject.toml", "README.md", "Makefile"
PAIRS = "Lt GtE", "Gt LtE", "Eq NotEq", "Is IsNot", "In NotIn", "Add Sub", "Mult Div", "And Or"
OTHER = {getattr(ast, a): getattr(ast, b) for a, b in (pair.split()[::way] for pair in PAIRS for way in (1, -1))}
OTHER |= {ast.Pow: ast.Mult, ast.FloorDiv: ast.Mult}


def changed(node):
    """Return a changed copy of a node, or None if there is no change for its kind."""
    new = copy.deepcopy(node)
    match new:
        case ast.Compare(ops=[op]) if type(op) in OTHER:
            new.ops = [OTHER[type(op)]()]
        case ast.BinOp(op=op) | ast.BoolOp(op=op) if type(op) in OTHER:
            new.op = OTHER[type(op)]()
        case ast.UnaryOp(op=ast.USub() | ast.Not()):
            return new.operand
        case ast.Constant(value=bool(value)):
            new.value = not value
        case ast.Constant(value=int(value) | float(value)):
            new.value = value + 1 if isinstance(value, int) else 1.1 * value or 1.0
        case ast.IfExp():
            new.test = ast.UnaryOp(ast.Not(), new.test)
        case _:
            return None
    return new


def without_effect(tree):
    """Yield the nodes that state a type, decorate or only guard (`strict=True`): their change changes no result."""
    for node in ast.walk(tree):
        if isinstance(node, ast.keyword) and node.arg == "strict":
            yield node.value
        types = [getattr(node, "annotation", None), getattr(node, "returns", None)]
        for part in filter(None, [*types, *getattr(node, "decorator_list", ())]):
            yield from ast.walk(part)


def mutants_of(file):
    """Yield (file, description, text of the whole file) of all mutants of a file."""
    data = (ROOT / file).read_bytes()
    tree, lines = ast.parse(data), data.splitlines(keepends=True)
    starts, without = [sum(map(len, lines[:k])) for k in range(len(lines))], {*without_effect(tree)}
    for node in ast.walk(tree):
        if node not in without and (new := changed(node)) is not None:
            begin, end = starts[node.lineno - 1] + node.col_offset, starts[node.end_lineno - 1] + node.end_col_offset
            after = f"({ast.unparse(new)})"
            text = (data[:begin] + after.encode() + data[end:]).decode()
            yield file, f"{file}:{node.lineno}  {data[begin:end].decode()}  ->  {after}", text


def tests_of(file):
    """Return the test files that import the module of a file, and those of its name; else all tests of its room."""
    package, _, name = (module := file.removesuffix(".py").removesuffix("/__init__").replace("/", ".")).rpartition(".")
    found, room = [], ROOT / "tests" / Path(*package.split(".")[1:])
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        nodes = [node for node in ast.walk(ast.parse(path.read_bytes())) if isinstance(node, ast.ImportFrom)]
        names = {each.name for node in nodes if node.module == package for each in node.names}
        if name in names or any(node.module == module for node in nodes) or path == room / f"test_{name}.py":
            found.append(path)
    return [path.relative_to(ROOT).as_posix() for path in found or sorted(room.rglob("test_*.py"))]


def is_killed(file, text, tree, marks):
    """Return True if a test of the file's module fails in the copy `tree` with this text."""
    (tree / file).write_text(text, encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *marks, *tests_of(file)]
    try:
        env = {**os.environ, "PYTHONPATH": str(tree)}
        return subprocess.run(command, cwd=tree, env=env, capture_output=True, timeout=TIMEOUT).returncode == 1
    except subprocess.TimeoutExpired:
        return True
    finally:
        shutil.copy(ROOT / file, tree / file)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=150)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--all", action="store_true", help="run the thorough tests, too")
    parser.add_argument("--only", type=int, nargs="*", help="numbers of the mutants to run, from 0")
    given = parser.parse_args()
    paths = [path for room in ROOMS for path in sorted((ROOT / "bstcad" / room).rglob("*.py"))]
    every = [mutant for path in paths for mutant in mutants_of(path.relative_to(ROOT).as_posix())]
    drawn, killed = random.Random(given.seed).sample(every, given.count), 0
    numbers, marks = given.only or range(len(drawn)), ["-m", "not slow and not bench"] if given.all else []
    with tempfile.TemporaryDirectory() as folder:
        for path in map(ROOT.joinpath, COPIED):
            (shutil.copytree if path.is_dir() else shutil.copy)(path, Path(folder, path.name))
        for number in numbers:
            file, change, text = drawn[number]
            killed += (died := is_killed(file, text, Path(folder), marks))
            print(f"{number:4} {'killed  ' if died else 'SURVIVED'} {change}", flush=True)
    print(f"{killed} of {len(numbers)} mutants killed ({len(every)} possible)")


if __name__ == "__main__":
    main()
