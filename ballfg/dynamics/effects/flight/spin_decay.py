"""Spin decay: the air slows the spin."""

from torch import Tensor

from ballfg.dynamics.effect import Coefficient, Flight, FlightEffect


class SpinDecay(FlightEffect):
    """dw/dt = -rate w. No measured value was found for table tennis; 0 switches it off, 0.2 1/s is a slow decay."""

    name = "spin_decay"
    sentence = "Viscous torque of the air: the spin falls exponentially."
    decide = "Film a mark on the ball at launch and at the end of a long flight, or label the spin at both ends."
    coefficients = (Coefficient("rate", 0.2, 0.2, "1/s", 0.0, 20.0),)
    rate: Tensor

    def spin_rate(self, flight: Flight) -> Tensor:
        """(..., 3) rad/s^2, opposite to the spin."""
        return -self.rate * flight.spin
