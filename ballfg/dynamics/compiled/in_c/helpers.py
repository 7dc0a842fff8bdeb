"""Functions of generated code that C has by hand: in Python they call BLAS, or take numbers apart into bits."""

from typing import Final

ADD_PRODUCT: Final = """\
/* Add matrix products (m, k) (k, n) to matrices whose rows lie one behind another. */
static inline void NAME(double *whole, int whole_at, int whole_step,
    const double *left, int left_at, int left_step, int left_row, int left_column,
    const double *right, int right_at, int right_step, int right_row, int right_column,
    int count, int m, int k, int n) {
  for (int q = 0; q < count; ++q)
    for (int i = 0; i < m; ++i) {
      double *into = whole + whole_at + q * whole_step + i * n;
      for (int r = 0; r < k; ++r) {
        const double factor = left[left_at + q * left_step + i * left_row + r * left_column];
        const double *from = right + right_at + q * right_step + r * right_row;
        if (right_column == 1)
          for (int j = 0; j < n; ++j) into[j] += factor * from[j];
        else
          for (int j = 0; j < n; ++j) into[j] += factor * from[j * right_column];
      }
    }
}"""
"""`layers.add_product`."""
TANH_ALL: Final = """\
/* Hyperbolic tangents of n numbers: exp's series and a rational function near zero, several numbers at a time. */
static inline void NAME(const double *x, double *y, int n) {
  for (int i = 0; i < n; ++i) {
    const double size = fabs(x[i]), v = -2.0 * (size > 20.0 ? 20.0 : size);
    union { double number; int64_t bits; } power;
    power.number = v * 1.4426950408889634 + 6755399441055744.0;
    const double k = power.number - 6755399441055744.0;
    const double r = (v - k * 6.93147180369123816490e-01) - k * 1.90821492927058770002e-10;
    double s = 1.0 / 6227020800.0;
    s = s * r + 1.0 / 479001600.0;
    s = s * r + 1.0 / 39916800.0;
    s = s * r + 1.0 / 3628800.0;
    s = s * r + 1.0 / 362880.0;
    s = s * r + 1.0 / 40320.0;
    s = s * r + 1.0 / 5040.0;
    s = s * r + 1.0 / 720.0;
    s = s * r + 1.0 / 120.0;
    s = s * r + 1.0 / 24.0;
    s = s * r + 1.0 / 6.0;
    s = s * r + 0.5;
    s = s * r + 1.0;
    s = s * r + 1.0;
    power.bits = (int64_t)(((uint64_t)power.bits << 52) + ((uint64_t)1023 << 52));
    const double e = s * power.number, far_out = (1.0 - e) / (1.0 + e), square = x[i] * x[i];
    const double above =
      (-9.64399179425052238628e-1 * square - 9.92877231001918586564e1) * square - 1.61468768441708447952e3;
    const double below = (square + 1.12811678491632931402e2) * square + 2.23548839060100448583e3;
    const double close = x[i] + x[i] * square * (above / (below * square + 4.84406305325125486048e3));
    y[i] = size >= 0.625 ? (x[i] > 0.0 ? far_out : -far_out) : close;
  }
}"""
"""`layers.tanh_all`."""
BY_HAND: Final = {"add_product": (ADD_PRODUCT, [True, *[False] * 16]), "tanh_all": (TANH_ALL, [False, True, False])}
"""By name: the C text, and which of the arguments are written to. Where the last one is an array its size follows."""
