"""Mutants: change one operator, constant or condition of the package, and run the tests that import its module.

    python -m tests.mutants --count 150 --seed 1          # by the daily tests
    python -m tests.mutants --count 150 --seed 1 --all    # by the thorough ones, too
    python -m tests.mutants --count 150 --seed 1 --only 3 17

A mutant is killed if a test fails, or if the tests take longer than TIMEOUT.  A mutant that survives is equivalent, or
asks for a test.  `<` becomes `>=`, not `<=`, which differs only for equal numbers.
"""

from __future__ import annotations

import argparse
import ast
import copy
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
ROOMS = "optics", "transport", "tailoring", "cad", "verify", "step_text"
TIMEOUT = 900  # seconds for the tests of one mutant; a kernel is compiled again
COPIED = "bstcad", "tests", "templates", "docs", "generate_lens.py", "pyproject.toml", "README.md", "Makefile"
PAIRS = (
    (ast.Lt, ast.GtE), (ast.Gt, ast.LtE), (ast.Eq, ast.NotEq), (ast.Is, ast.IsNot), (ast.In, ast.NotIn),
    (ast.Add, ast.Sub), (ast.Mult, ast.Div), (ast.And, ast.Or),
)  # fmt: skip
OTHER = {one: other for pair in PAIRS for one, other in (pair, pair[::-1])} | {
    ast.Pow: ast.Mult,
    ast.FloorDiv: ast.Mult,
}


class Mutant(NamedTuple):
    """One changed place of a file."""

    file: str  # path from the root of the tree
    line: int
    before: str
    after: str
    text: str  # text of the whole file


def changes(node: ast.AST) -> Iterator[ast.AST]:
    """Yield a changed copy of a node, if there is a change for its kind."""
    new = copy.deepcopy(node)
    match new:
        case ast.Compare(ops=[op]) if type(op) in OTHER:
            new.ops = [OTHER[type(op)]()]
        case ast.BinOp(op=op) | ast.BoolOp(op=op) if type(op) in OTHER:
            new.op = OTHER[type(op)]()
        case ast.UnaryOp(op=ast.USub() | ast.Not()):
            new = new.operand
        case ast.Constant(value=bool(value)):
            new.value = not value
        case ast.Constant(value=int(value)):
            new.value = value + 1
        case ast.Constant(value=float(value)):
            new.value = 1.1 * value or 1.0
        case ast.IfExp():
            new.test = ast.UnaryOp(ast.Not(), new.test)
        case _:
            return
    yield new


def skipped(tree: ast.AST) -> set[ast.AST]:
    """Return the nodes that state a type, decorate or only guard (`strict=True`): their change changes no result."""
    found = {node.value for node in ast.walk(tree) if isinstance(node, ast.keyword) and node.arg == "strict"}
    for node in ast.walk(tree):
        for part in (
            getattr(node, "annotation", None),
            getattr(node, "returns", None),
            *getattr(node, "decorator_list", ()),
        ):
            found |= set(ast.walk(part)) if part is not None else set()
    return found


def mutants_of(file: str) -> Iterator[Mutant]:
    """Yield all mutants of a file; several nodes of one text give one mutant."""
    text = (ROOT / file).read_text(encoding="utf-8")
    tree, lines = ast.parse(text), text.encode().splitlines(keepends=True)
    starts = [sum(map(len, lines[:k])) for k in range(len(lines))]
    without = skipped(tree)
    for node in ast.walk(tree):
        for new in changes(node) if node not in without else ():
            begin, end = starts[node.lineno - 1] + node.col_offset, starts[node.end_lineno - 1] + node.end_col_offset
            after, data = f"({ast.unparse(new)})", text.encode()
            changed = data[:begin] + after.encode() + data[end:]
            yield Mutant(file, node.lineno, data[begin:end].decode(), after, changed.decode())


def tests_of(module: str) -> list[str]:
    """Return the test files that import a module, such as bstcad.optics.lens.lens."""
    package, _, name = module.rpartition(".")
    found = []
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        nodes = [
            node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, ast.ImportFrom)
        ]
        direct = any(node.module == module for node in nodes)
        if direct or any(node.module == package and name in {each.name for each in node.names} for node in nodes):
            found.append(path.relative_to(ROOT).as_posix())
    return found


def is_killed(mutant: Mutant, tree: Path, marks: list[str]) -> bool:
    """Return True if a test of the mutant's module fails in the copy `tree`."""
    module = mutant.file.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
    if not (files := tests_of(module)):
        return False
    (tree / mutant.file).write_text(mutant.text, encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *marks, *files]
    known = {**os.environ, "PYTHONPATH": str(tree)}
    try:
        return subprocess.run(command, cwd=tree, env=known, capture_output=True, timeout=TIMEOUT).returncode == 1
    except subprocess.TimeoutExpired:
        return True
    finally:
        shutil.copy(ROOT / mutant.file, tree / mutant.file)


def main() -> None:
    """Draw mutants, and print the state of each and the share that is killed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=150)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--all", action="store_true", help="run the thorough tests, too")
    parser.add_argument("--only", type=int, nargs="*", help="numbers of the mutants to run, from 0")
    given = parser.parse_args()
    files = [path for room in ROOMS for path in sorted((ROOT / "bstcad" / room).rglob("*.py"))]
    every = [mutant for path in files for mutant in mutants_of(path.relative_to(ROOT).as_posix())]
    drawn = random.Random(given.seed).sample(every, given.count)
    numbers, killed = range(len(drawn)) if given.only is None else given.only, 0
    with tempfile.TemporaryDirectory() as folder:
        for name in COPIED:
            copied = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
            copied(ROOT / name, Path(folder, name))
        for number in numbers:
            mutant = drawn[number]
            died = is_killed(mutant, Path(folder), ["-m", "not slow and not bench"] if given.all else [])
            killed, word = killed + died, "killed  " if died else "SURVIVED"
            print(f"{number:4} {word} {mutant.file}:{mutant.line}  {mutant.before}  ->  {mutant.after}", flush=True)
    print(f"{killed} of {len(numbers)} mutants killed ({len(every)} possible)")


if __name__ == "__main__":
    main()
