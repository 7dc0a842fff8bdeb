import numpy as np

from ballfg.benchmarks.gaussian_settings import StepNoise


def test_step_noise_does_not_depend_on_the_step_but_for_spin() -> None:
    covariance = StepNoise(spin=2.0, step_position=0.1, step_velocity=0.3).flight(np.array([0.01, 0.04]))
    expected = np.diag([0.01] * 3 + [0.09] * 3 + [0.04] * 3)
    np.testing.assert_allclose(covariance[0], expected)
    expected[6:, 6:] *= 4
    np.testing.assert_allclose(covariance[1], expected)
