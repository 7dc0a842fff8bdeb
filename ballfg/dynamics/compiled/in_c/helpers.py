"""Functions of generated code that C has by hand: in Python they call BLAS, or take numbers apart into bits."""

from typing import Final

ADD_PRODUCT: Final = """\
/* Add matrix products (m, k) (k, n) to matrices whose rows lie one behind another. */
static inline void NAME(double *whole, int whole_at, int whole_step,
    const double *left, int left_at, int left_step, int left_row, int left_column,
    const double *right, int right_at, int right_step, int right_row, int right_column,
    int count, int m, int k, int n, int anew) {
  for (int q = 0; q < count; ++q)
    for (int i = 0; i < m; ++i) {
      double *into = whole + whole_at + q * whole_step + i * n;
      for (int j = 0; anew && j < n; ++j) into[j] = 0.0;
      if (right_column == 1)
        for (int r = 0; r < k; ++r) {
          const double factor = left[left_at + q * left_step + i * left_row + r * left_column];
          const double *from = right + right_at + q * right_step + r * right_row;
          for (int j = 0; j < n; ++j) into[j] += factor * from[j];
        }
      else
        for (int j = 0; j < n; ++j) {
          const double *row = left + left_at + q * left_step + i * left_row;
          const double *column = right + right_at + q * right_step + j * right_column;
          double sums[4] = {0.0, 0.0, 0.0, 0.0};
          int r = 0;
          for (; r + 3 < k; r += 4)
            for (int l = 0; l < 4; ++l) sums[l] += row[(r + l) * left_column] * column[(r + l) * right_row];
          for (; r < k; ++r) sums[0] += row[r * left_column] * column[r * right_row];
          into[j] += (sums[0] + sums[1]) + (sums[2] + sums[3]);
        }
    }
}"""
"""`layers.add_product`."""
TANH_ALL: Final = """\
/* Hyperbolic tangents of n numbers from exp's series, several numbers at a time. */
static inline void NAME(const double *x, double *y, int n) {
  for (int i = 0; i < n; ++i) {
    const double size = fabs(x[i]), v = -2.0 * (size > 20.0 ? 20.0 : size);
    union { double number; int64_t bits; } power;
    power.number = v * 1.4426950408889634 + 6755399441055744.0;
    const double k = power.number - 6755399441055744.0;
    const double r = (v - k * 6.93147180369123816490e-01) - k * 1.90821492927058770002e-10, square = r * r;
    double series = 4.13813679705723846039e-08 * square - 1.65339022054652515390e-06;
    series = (series * square + 6.61375632143793436117e-05) * square - 2.77777777770155933842e-03;
    series = (series * square + 1.66666666666666019037e-01) * square + 2.0;
    power.bits = (int64_t)(((uint64_t)power.bits << 52) + ((uint64_t)1023 << 52));
    const double less = 1.0 - power.number, more = 1.0 + power.number;
    y[i] = copysign((less * series - more * r) / (more * series - less * r), x[i]);
  }
}"""
"""`layers.tanh_all`."""
BY_HAND: Final = {"add_product": (ADD_PRODUCT, [True, *[False] * 17]), "tanh_all": (TANH_ALL, [False, True, False])}
"""By name: the C text, and which of the arguments are written to. Where the last one is an array its size follows."""
