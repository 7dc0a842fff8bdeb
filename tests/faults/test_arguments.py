"""Wrong arguments of the Python interface: refused in one line by the package itself, without a warning from others."""

import pytest

import ballfg as bf
from tests.faults.arguments import GROUPS, Call, faults_of

WRONG_BY_PURPOSE = {
    "read",
    "load_model",
    "diagnose",
    "error_budget",
    "register",
    "register_estimator",
    "register_observation",
}
"""Calls whose own arguments are refused too: what they need is files or classes."""

MADE = {"BallState", "Dataset", "Diagnosis", "Estimate", "Status", "TrackGraph"}
"""Public classes that the package makes, not the user."""


@pytest.mark.parametrize("group", GROUPS)
def test_each_argument_refuses_what_it_cannot_take_in_one_line(group, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    calls = GROUPS[group](tmp_path)
    for name, call in calls.items():
        if name not in WRONG_BY_PURPOSE:
            call.function(**call.arguments)  # else every value would be refused for another reason
    faults = [f"{name} {fault}" for name, call in calls.items() for fault in faults_of(call)]
    assert not faults, "\n".join(faults)


def test_an_error_of_python_itself_is_a_fault():
    def half(number):
        return number / 2

    found = {fault.value for fault in faults_of(Call(half, {"number": 1.0}))}
    assert {"None", "'x'", "{}"} <= found
    assert not {"0", "1e+300"} & found


def test_every_public_name_is_called(tmp_path):
    called = {name for make in GROUPS.values() for name in make(tmp_path)}
    assert {name for name in bf.__all__ if callable(getattr(bf, name))} - MADE <= called
