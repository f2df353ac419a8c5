"""The fault that each module of hard cases was seen to catch: a guard of the program, and the same line without it.

test_mutations.py holds the lines to the sources; `make bench` puts each fault into a copy of the program and sees the
module fail.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Mutation:
    """One fault."""

    module: str  # of tests/hard_cases, without ".py"
    file: str  # of the program, from its root
    guard: str  # stands once in the file
    fault: str  # in its place
    select: str = ""  # pytest -k: the tests that see it, where the module is long


MUTATIONS: tuple[Mutation, ...] = ()
