"""Many minimisations in lockstep, so that they share torch calls.

A search (`ballfg.factors.graph.Search`) asks for linearisations and for solutions of linear systems. `run_together`
answers many searches at once: factors of the same sort, of whatever graph, are evaluated in one call, which costs
little more than a single graph's. On a device the linear systems are solved together too.
"""

from collections import defaultdict
from collections.abc import Hashable, Sequence

import numpy as np
import torch

from ballfg.factors.batch import FactorBatch, Rows, Values, merge
from ballfg.factors.graph import Linearization, LinearSolution, Question, R, Search
from ballfg.factors.linear.step import Step
from ballfg.factors.linear.together import solve_together


def run_together(searches: Sequence[Search[R]], device: torch.device | None = None) -> list[R]:
    """The results of several searches, in order; each is the same as by itself, up to rounding.

    Args:
        searches: that ask for linearisations and solutions of linear systems.
        device: computes motion and linear systems in torch, many at once. None: machine code, each system by itself.
    """
    results: dict[int, R] = {}
    questions: dict[int, Question] = {}

    def ask(number: int, answer: list[Rows] | Step | None) -> None:
        try:
            question = searches[number].send(answer)  # None begins a search
            while device is None and isinstance(question, LinearSolution):
                question = searches[number].send(question.answer())
            questions[number] = question
        except StopIteration as end:
            questions.pop(number, None)
            results[number] = end.value

    for number in range(len(searches)):
        ask(number, None)
    while questions:
        points = {number: one for number, one in questions.items() if isinstance(one, Linearization)}
        systems = {number: one for number, one in questions.items() if isinstance(one, LinearSolution)}
        if device is None or len(points) >= len(systems):  # the larger half: the others wait for company
            for number, rows in zip(points, linearize_together(list(points.values()), device), strict=True):
                ask(number, rows)
        else:
            for number, step in zip(systems, solve_together(list(systems.values()), device), strict=True):
                ask(number, step)
    return [results[number] for number in range(len(searches))]


def linearize_together(questions: Sequence[Linearization], device: torch.device | None = None) -> list[list[Rows]]:
    """Each graph linearised at its point, with one evaluation for all costly batches of the same group.

    Args: questions: graphs and points.  device: where motion is computed; None: machine code.
    """
    answers: list[list[Rows]] = [[] for _ in questions]
    groups: defaultdict[Hashable, list[tuple[int, int, FactorBatch]]] = defaultdict(list)
    for number, question in enumerate(questions):
        for batch in question.graph.batches:
            if not len(batch):
                continue
            if batch.costly:
                groups[batch.group].append((number, len(answers[number]), batch))
                answers[number].append(Rows(batch.variables, np.empty(0), (), batch.loss))  # its place, filled below
            else:
                answers[number].append(batch.linearize(question.values))
    for members in groups.values():
        points = [questions[number].values for number, _, _ in members]
        together = _evaluate([batch for _, _, batch in members], points, device)
        for (number, place, _), rows in zip(members, together, strict=True):
            answers[number][place] = rows
    return answers


def _evaluate(batches: Sequence[FactorBatch], points: Sequence[Values], device: torch.device | None) -> list[Rows]:
    """Batches of one group, each linearised at its own point."""
    if len(batches) == 1 and device is None:
        return [batches[0].linearize(points[0])]
    gathered = [batch.inputs(values) for batch, values in zip(batches, points, strict=True)]
    inputs = tuple(np.concatenate(pieces) for pieces in zip(*gathered, strict=True))
    whole = merge(batches) if device is None else merge(batches).on(device)
    residual, jacobians = whole.compute(slice(None), inputs)
    ends = np.cumsum([len(batch) for batch in batches])[:-1]
    residuals = np.split(residual, ends)
    blocks = [np.split(jacobian, ends) for jacobian in jacobians]
    return [batch.rows(points[i], residuals[i], tuple(block[i] for block in blocks)) for i, batch in enumerate(batches)]
