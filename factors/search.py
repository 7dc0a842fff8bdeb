"""Minimisations that ask for what they need, so that several of them can share a torch call.

A search yields a graph and a point, and is sent back the graph linearised there; what it returns is its result. One
search is answered as it asks (`run`). Many are run in lockstep (`run_together`): factors of the same sort, of whatever
graph, are then evaluated in one call, which costs little more than a single graph's.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Generator, Hashable, Sequence
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from ballfg.factors.batch import FactorBatch, Rows, Values, merge

if TYPE_CHECKING:
    from ballfg.factors.graph import BallGraph

R = TypeVar("R")

Question = tuple["BallGraph", Values]
Search = Generator[Question, list[Rows], R]


def run(search: Search[R]) -> R:
    """The result of one search."""
    try:
        graph, values = next(search)
        while True:
            graph, values = search.send(graph.linearize(values))
    except StopIteration as end:
        return end.value


def run_together(searches: Sequence[Search[R]]) -> list[R]:
    """The results of several searches, in order; each is the same as by itself, up to rounding."""
    results: dict[int, R] = {}
    questions: dict[int, Question] = {}

    def ask(number: int, rows: list[Rows] | None) -> None:
        try:
            questions[number] = next(searches[number]) if rows is None else searches[number].send(rows)
        except StopIteration as end:
            questions.pop(number, None)
            results[number] = end.value

    for number in range(len(searches)):
        ask(number, None)
    while questions:
        open_numbers = list(questions)
        for number, rows in zip(open_numbers, linearize_together(list(questions.values())), strict=True):
            ask(number, rows)
    return [results[number] for number in range(len(searches))]


def linearize_together(questions: Sequence[Question]) -> list[list[Rows]]:
    """Each graph linearised at its point, with one evaluation for all costly kinds of the same group."""
    answers: list[list[Rows]] = [[] for _ in questions]
    groups: defaultdict[Hashable, list[tuple[int, int, FactorBatch]]] = defaultdict(list)
    for number, (graph, values) in enumerate(questions):
        for kind in graph.kinds:
            if not len(kind):
                continue
            if kind.costly:
                groups[kind.group].append((number, len(answers[number]), kind))
                answers[number].append(Rows(kind.variables, np.empty(0), (), kind.loss))  # its place, filled below
            else:
                answers[number].append(kind.linearize(values))
    for members in groups.values():
        points = [questions[number][1] for number, _, _ in members]
        for (number, place, _), rows in zip(members, _evaluate([k for _, _, k in members], points), strict=True):
            answers[number][place] = rows
    return answers


def _evaluate(kinds: Sequence[FactorBatch], points: Sequence[Values]) -> list[Rows]:
    """Kinds of one group, each linearised at its own point."""
    if len(kinds) == 1:
        return [kinds[0].linearize(points[0])]
    gathered = [
        [values.gather(column) for column in kind.variables.T] for kind, values in zip(kinds, points, strict=True)
    ]
    inputs = tuple(np.concatenate(pieces) for pieces in zip(*gathered, strict=True))
    residual, jacobians = merge(kinds).compute(slice(None), inputs)
    ends = np.cumsum([len(kind) for kind in kinds])[:-1]
    residuals = np.split(residual, ends)
    blocks = [np.split(jacobian, ends) for jacobian in jacobians]
    return [
        Rows(kind.variables, residuals[i], tuple(block[i] for block in blocks), kind.loss)
        for i, kind in enumerate(kinds)
    ]
