"""Remarks on fitted coefficients: those that tracks pull to a bound, and none where a model is right."""

from __future__ import annotations

from dataclasses import replace

from ballfg.diagnosis.diagnosis import strange
from ballfg.diagnosis.fit.fit import first_guess, fit_problem, values_of
from ballfg.diagnosis.fit.free import declared_free
from ballfg.diagnosis.fit.problem import Problem


def remarks(model, stretches, low):
    """Of a fit in which the drag may not fall below a bound, 1/m."""
    free = declared_free(model)
    free["flight.drag.k"] = replace(free["flight.drag.k"], low=low)
    unknowns, noise = first_guess(problem := Problem(model, stretches, free), 4.0, 60.0)
    found = fit_problem(problem, unknowns, noise, settle_noise=False)
    declared = {name: float(value.detach()) for name, value in model.named_parameters()}
    return strange(found, values_of(found, list(free), declared), model.radius)


def test_a_coefficient_that_tracks_pull_to_its_bound_is_told(make_ball, make_launches, make_shots):
    model = make_ball()
    data = make_shots(model, make_launches(8, 15), 15).stretches
    assert remarks(model, data, low=0.0) == []
    wrong = remarks(model.requires_grad_(False), data, low=0.16)
    assert [("drag.k = 0.16 1/m is the bound" in said) for said in wrong] == [True]
