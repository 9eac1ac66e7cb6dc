"""Writes kid.json: KID of two sets of feature vectors, in numpy.

    pip install numpy
    python3 tests/eval/kid.py

The formula of Binkowski et al. 2018, as a mean over all pairs. `tests/eval/kid.rs` compares with it.
"""

import json
from pathlib import Path

import numpy as np


def kid(a, b):
    kernel = lambda x, y: (x @ y.T / x.shape[1] + 1) ** 3
    aa, bb, ab = kernel(a, a), kernel(b, b), kernel(a, b)
    m, n = len(a), len(b)
    within_a = (aa.sum() - np.trace(aa)) / (m * (m - 1))
    within_b = (bb.sum() - np.trace(bb)) / (n * (n - 1))
    return within_a + within_b - 2 * ab.mean()


def main():
    random = np.random.default_rng(11)
    cases = []
    for m, n, length, shift in [(9, 14, 8, 0.0), (20, 6, 32, 0.4), (2, 2, 5, -1.0)]:
        # Exact in f32, as networks give them.
        a, b = (
            random.normal(mean, 1, (count, length)).astype(np.float32).astype(np.float64)
            for count, mean in [(m, 0), (n, shift)]
        )
        cases.append({"a": a.tolist(), "b": b.tolist(), "kid": float(kid(a, b))})
    Path(__file__).with_suffix(".json").write_text(json.dumps(cases) + "\n")


if __name__ == "__main__":
    main()
