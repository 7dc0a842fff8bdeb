"""Many minimisations in lockstep, so that they share torch calls.

A search (`ballfg.factors.graph.Search`) asks for linearisations. `run_together` answers many searches at once: factors
of the same sort, of whatever graph, are evaluated in one call, which costs little more than a single graph's.
"""

from collections import defaultdict
from collections.abc import Hashable, Sequence

import numpy as np

from ballfg.factors.batch import FactorBatch, Rows, Values, merge
from ballfg.factors.graph import Question, R, Search


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
    """Each graph linearised at its point, with one evaluation for all costly batches of the same group."""
    answers: list[list[Rows]] = [[] for _ in questions]
    groups: defaultdict[Hashable, list[tuple[int, int, FactorBatch]]] = defaultdict(list)
    for number, (graph, values) in enumerate(questions):
        for batch in graph.batches:
            if not len(batch):
                continue
            if batch.costly:
                groups[batch.group].append((number, len(answers[number]), batch))
                answers[number].append(Rows(batch.variables, np.empty(0), (), batch.loss))  # its place, filled below
            else:
                answers[number].append(batch.linearize(values))
    for members in groups.values():
        points = [questions[number][1] for number, _, _ in members]
        for (number, place, _), rows in zip(members, _evaluate([k for _, _, k in members], points), strict=True):
            answers[number][place] = rows
    return answers


def _evaluate(batches: Sequence[FactorBatch], points: Sequence[Values]) -> list[Rows]:
    """Batches of one group, each linearised at its own point."""
    if len(batches) == 1:
        return [batches[0].linearize(points[0])]
    gathered = [batch.inputs(values) for batch, values in zip(batches, points, strict=True)]
    inputs = tuple(np.concatenate(pieces) for pieces in zip(*gathered, strict=True))
    residual, jacobians = merge(batches).compute(slice(None), inputs)
    ends = np.cumsum([len(batch) for batch in batches])[:-1]
    residuals = np.split(residual, ends)
    blocks = [np.split(jacobian, ends) for jacobian in jacobians]
    return [batch.rows(points[i], residuals[i], tuple(block[i] for block in blocks)) for i, batch in enumerate(batches)]
