"""Chooses c and P of `Real::normal_cumulative` for f32, and prints them with the largest relative error (numpy, scipy).

Fitted is exp(x^2/2) Phi(-x) = t P(t), t = 1/(1 + c x), x from 0 to 14, by least squares that are weighted again with
their errors."""

import numpy as np
from scipy.special import erfcx

DEGREE = 7
best = (np.inf, 0.0, None)
for c in np.linspace(0.2, 0.6, 81):
    t = 0.5 * (1 - np.cos(np.pi * (np.arange(4000) + 0.5) / 4000))
    t = t[t > 1 / (1 + c * 14)]
    exact = erfcx((1 / t - 1) / c / np.sqrt(2)) / 2
    terms = np.vander(t, DEGREE + 1, increasing=True) * (t / exact)[:, None]
    weights = np.ones(len(t))
    for _ in range(60):
        root = np.sqrt(weights)
        p = np.linalg.lstsq(terms * root[:, None], root, rcond=None)[0]
        error = np.abs(terms @ p - 1)
        weights = weights * (error + 1e-16)
        weights /= weights.sum()
    best = min(best, (error.max(), c, p), key=lambda found: found[0])
print("largest relative error %.2g, c = %.3f, P = %s" % (best[0], best[1], np.array2string(best[2], precision=8)))
